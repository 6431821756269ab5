"""What can be told apart on a machine: computed once, without a path in what is answered."""

from __future__ import annotations

import asyncio
import sys
from typing import TYPE_CHECKING, Any

import pytest
from jinja2 import Environment, PackageLoader
from support.waiting import eventually
from test_views import about

from daqsvc.page import detectable
from daqsvc.page.detectable import NOT_HERE, Detectabilities, Detectable, why_no_detector
from daqsvc.page.machine_live import MachineLive

if TYPE_CHECKING:
    from pathlib import Path


async def computed(made: Detectabilities, live: MachineLive) -> Detectable:
    found: list[Detectable] = []

    def is_there() -> bool:
        told = made.of(live)
        found.extend([told] if told is not None else [])
        return bool(found)

    await eventually(is_there, "it is computed")
    return found[0]


def program(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, text: str) -> None:
    """Have a shell script in place of ``python -m daqsvc``."""
    script = tmp_path / "program"
    script.write_text(f"#!/bin/sh\n{text}\n")
    script.chmod(0o700)
    monkeypatch.setattr(sys, "executable", f"{script}")


async def test_it_is_computed_once_for_a_machine_file(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    program(monkeypatch, tmp_path, f"echo ran >> {tmp_path}/runs; echo all modes")
    live, made = MachineLive(about()), Detectabilities()
    for _ in range(3):
        assert await computed(made, live) == Detectable("all modes\n", "")
    assert (tmp_path / "runs").read_text() == "ran\n"
    await made.close()


async def test_a_failure_is_told_without_paths_and_tried_again(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    folder = tmp_path / "my plant"
    said = f"cannot read {folder}/bus.dbc or /etc/daqsvc/x.toml: 3 mm/s and 2 m/s2"
    program(monkeypatch, tmp_path, f"echo ran >> {tmp_path}/runs; echo '{said}' >&2; exit 1")
    live, made = MachineLive(about() | {"folder": f"{folder}"}), Detectabilities()
    for _ in range(2):
        told = await computed(made, live)
        assert told == Detectable("", "cannot read bus.dbc or x.toml: 3 mm/s and 2 m/s2")
    assert (tmp_path / "runs").read_text() == "ran\n" * 2
    await made.close()


@pytest.mark.parametrize("name", ["/etc/shadow", "../../x.dbc"])
async def test_a_machine_of_elsewhere_opens_no_file_here(
    name: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    program(monkeypatch, tmp_path, f"touch {tmp_path}/ran")
    known: dict[str, Any] = about()
    known["values"]["streams"] = {"shaft": {"layout": [{"dbc_file": name}]}}
    made = Detectabilities()
    assert await computed(made, MachineLive(known)) == Detectable("", NOT_HERE)
    assert not (tmp_path / "ran").exists()
    await made.close()


async def test_what_takes_too_long_is_ended(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(detectable, "LIMIT_S", 0.2)
    program(monkeypatch, tmp_path, "exec sleep 1000")
    made = Detectabilities()
    assert "longer than 0.2 s" in (await computed(made, MachineLive(about()))).why_not
    await made.close()
    await asyncio.sleep(0)


def test_a_machine_without_such_a_detector_says_so_where_one_would_look() -> None:
    known: dict[str, Any] = about()
    known["values"]["pipeline"] = {"levels": [{"name": "a"}]}
    why = why_no_detector(MachineLive(known))
    assert "none of the detectors that can show it: rotor_bank, rotor_synchronous" in why
    known["values"]["pipeline"]["rotor_synchronous"] = {}
    assert not why_no_detector(MachineLive(known))
    navigation = Environment(loader=PackageLoader("daqsvc.page"), autoescape=True).get_template(
        "navigation.html"
    )
    link = 'class="absent" title="no such detector">Detectability'
    assert link in navigation.render(machine="m", views=[], no_detectability="no such detector")
    assert "absent" not in navigation.render(machine="m", views=[], no_detectability="")
