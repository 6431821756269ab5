"""The pictures of the documentation are what the product makes now, and pages show all of them."""

from __future__ import annotations

import re
import sqlite3
import sys
from contextlib import closing
from typing import TYPE_CHECKING
from xml.etree import ElementTree as ET

import matplotlib as mpl
import pytest
from support.paths import ROOT

sys.path.append(str(ROOT / "docs"))

from make_pictures import alarm_states, architecture, detectors, outbox
from make_pictures.catalogue import PICTURES
from make_pictures.style import save, use

from daqsvc.alarms.states import AlarmState, Stimulus, moves

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

pytestmark = [pytest.mark.integration, pytest.mark.sources]
FOLDER = ROOT / "docs" / "pictures"
NUMBER = re.compile(r"-?\d+(?:\.\d+)?(?:e-?\d+)?")
TOLERANCE_PX = 2.0
LONG = {"detector-bearing"}
"""What takes more than some seconds."""


@pytest.fixture(autouse=True)
def _own_style() -> Iterator[None]:
    with mpl.rc_context():
        use()
        yield


def parts(file: Path) -> list[tuple[str, str, list[float]]]:
    """What is in a picture: of each element its kind, its text, and where it is (its corners, for a path)."""
    found = []
    for element in ET.parse(file).iter():  # noqa: S314 - our own file
        kind = element.tag.rpartition("}")[2]
        text = (element.text or "").strip()
        if kind == "path":
            numbers = [float(n) for n in NUMBER.findall(element.get("d", ""))]
            where = [f(numbers[i::2]) for i in (0, 1) for f in (min, max)] if numbers else []
        elif kind in {"use", "text"}:
            where = [float(element.get(name, 0.0)) for name in ("x", "y")]
            where += [float(n) for n in NUMBER.findall(element.get("transform", ""))]
        else:
            where = []
        if kind in {"path", "use", "text"}:
            found.append((kind, text, where))
    return found


def same(one: Path, other: Path) -> bool:
    """Whether two pictures show the same; where a line runs may differ by a pixel or two."""
    first, second = parts(one), parts(other)
    return [part[:2] for part in first] == [part[:2] for part in second] and all(
        mine[2] == pytest.approx(its[2], abs=TOLERANCE_PX) for mine, its in zip(first, second, strict=True)
    )


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.long if name in LONG else ()) for name in PICTURES]
)
def test_a_picture_is_what_its_script_makes(name: str, tmp_path: Path) -> None:
    """If this fails, run: make pictures."""
    save(PICTURES[name](), tmp_path / "now.svg")
    assert same(FOLDER / f"{name}.svg", tmp_path / "now.svg")


def test_every_detector_that_comes_with_daqsvc_has_a_picture() -> None:
    assert set(detectors.DETECTORS) == set(
        architecture.PROJECT["project"]["entry-points"]["daqsvc.detectors"]
    )


def test_there_is_no_other_picture_and_a_page_shows_each() -> None:
    names = sorted(file.stem for file in FOLDER.glob("*.svg"))
    assert names == sorted(PICTURES)
    pages = "".join(page.read_text("utf-8") for page in (ROOT / "docs").glob("*.md"))
    assert [name for name in names if f"](pictures/{name}.svg)" not in pages] == []


def test_pictures_have_no_date_and_fit_a_page() -> None:
    for file in FOLDER.glob("*.svg"):
        text = file.read_text("utf-8")
        assert "<dc:date>" not in text
        assert "<text" in text, "text is text, not outlines"
        width = ET.fromstring(text).get("width", "")  # noqa: S314 - our own file
        assert float(width.removesuffix("pt")) * 96 / 72 == pytest.approx(700.0, abs=2.0)


def test_what_a_power_cut_leaves_of_the_outbox_is_of_one_moment(tmp_path: Path) -> None:
    """Copied file by file, the log of a database that is open may be gone, or be of another moment."""
    (tmp_path / "now").mkdir()
    with closing(sqlite3.connect(tmp_path / "now" / "outbox.sqlite")) as store:
        store.execute("PRAGMA journal_mode = WAL")
        store.execute("CREATE TABLE messages (number)")
        store.execute("INSERT INTO messages VALUES (1)")
        store.commit()
        store.execute("INSERT INTO messages VALUES (2)")
        (tmp_path / "now" / "outbox.sqlite.version").write_text("1")
        outbox.as_of_now(tmp_path / "now", tmp_path / "after")
    after = tmp_path / "after"
    assert sorted(file.name for file in after.iterdir()) == ["outbox.sqlite", "outbox.sqlite.version"]
    with closing(sqlite3.connect(after / "outbox.sqlite")) as store:
        assert store.execute("SELECT number FROM messages").fetchall() == [(1,)]


def test_another_move_of_alarms_is_another_picture(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    def fewer(*, latching: bool):
        return {
            move: after
            for move, after in moves(latching=latching).items()
            if move != (AlarmState.ACTIVE_ACKNOWLEDGED, Stimulus.ESCALATE)
        }

    monkeypatch.setattr(alarm_states, "moves", fewer)
    save(alarm_states.states(), tmp_path / "now.svg")
    assert not same(FOLDER / "alarm-states.svg", tmp_path / "now.svg")


def test_a_way_against_the_contract_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    upside_down = architecture.layers()[::-1]
    monkeypatch.setattr(architecture, "layers", lambda: upside_down)
    with pytest.raises(ValueError, match=r"pyproject\.toml has"):
        architecture.flow()
