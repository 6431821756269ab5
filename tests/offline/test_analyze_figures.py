"""Nothing in a figure is cut off, and what it shows has most of its place."""

from __future__ import annotations

import re

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from support.examples import first_of
from support.orbit_files import OPTIONS, UNBALANCE, Orbit
from support.paths import ROOT
from support.race_signals import RATE_HZ, SPEED_RPM, strikes

from daqsvc.cli import main

pytestmark = pytest.mark.integration
LONG = "a-recording-of-the-feed-pump-in-hall-3-on-a-monday-in-november-with-a-name-that-goes-on-and-on.npz"


@pytest.fixture
def drawn(monkeypatch):
    """Figures by the end of their names, with how they were laid out."""
    figures = {}

    def keep(figure, name, dpi):
        figure.set_dpi(dpi)
        FigureCanvasAgg(figure).draw()
        figures[str(name).removesuffix(".png").rpartition("-")[2]] = figure

    monkeypatch.setattr(Figure, "savefig", keep)
    return figures


def assert_whole(figure, least_width=0.75):
    page = figure.bbox
    texts = [figure._suptitle, *figure.legends]
    for axes in figure.axes:
        texts += [axes.xaxis.label, axes.yaxis.label, *([axes.get_legend()] if axes.get_legend() else [])]
    for text in texts:
        box = text.get_window_extent()
        assert box.x0 >= page.x0, text
        assert box.x1 <= page.x1, text
        assert box.y0 >= page.y0, text
        assert box.y1 <= page.y1, text
    shown = [axes.get_window_extent() for axes in figure.axes]
    assert max(box.x1 for box in shown) - min(box.x0 for box in shown) >= least_width * page.width


@pytest.mark.parametrize("name", first_of(LONG, "run.npz"))
def test_figures_of_a_rotor(analyze, drawn, tmp_path, name):
    run = Orbit(400, change=UNBALANCE).save(tmp_path / name)
    code, _, _ = analyze(run, *OPTIONS, "--plot", tmp_path)
    assert code == 0
    assert set(drawn) == {"orbit", "poincare", "plane", "probabilities", "innovations", "polar"}
    for figure in drawn.values():
        assert_whole(figure)


@pytest.mark.long
@pytest.mark.parametrize("has_mean", first_of(True, False))
def test_the_legend_of_innovations_names_lines_that_are_there(analyze, drawn, tmp_path, has_mean):
    orbit = Orbit(400, change=UNBALANCE)
    if has_mean:
        orbit.x, orbit.y = orbit.x + 20.0, orbit.y - 30.0
    code, _, _ = analyze(
        orbit.save(tmp_path / "run.npz"),
        *OPTIONS,
        *(() if has_mean else ("--ac-coupled",)),
        "--plot",
        tmp_path,
    )
    assert code == 0
    upper = drawn["innovations"].axes[0]
    named = [text.get_text() for text in upper.get_legend().get_texts()]
    assert named == [*(["mean"] if has_mean else []), "1X", "-1X", "2X", "-2X"]
    assert all(np.nanmax(line.get_ydata()) > upper.get_ylim()[0] for line in upper.get_lines())


@pytest.mark.parametrize("name", first_of(LONG, "run.npz"))
def test_figures_of_a_bearing(analyze, drawn, tmp_path, name):
    path = tmp_path / name
    np.savez(path, de=strikes("inner"), fs=RATE_HZ)
    options = ["--channels", "de", "--speed-rpm", SPEED_RPM, "--bearing", "6205-2RS"]
    code, _, _ = analyze(path, *options, "--plot", tmp_path)
    assert code == 0
    assert_whole(drawn["envelope"])


DOCS = ROOT


def test_the_docs_show_what_comes_out_of_a_measured_recording(data, capsys):
    """Of one record in all of them, to the digits that another computer may round otherwise."""
    record = str(data / "cwru" / "105.mat")
    options = ["--channels", "DE_time", "--fs", "12000", "--speed-rpm", "1797", "--bearing", "6205-2RS"]
    assert main(["analyze", record, *options]) == 0
    said = capsys.readouterr().out.splitlines()[:3]
    for name in ("README.md", "docs/analyze.md"):
        shown = re.search(r"^105\.mat: .*\n.*\n.*$", (DOCS / name).read_text(), re.MULTILINE)
        for line, expected in zip(
            shown[0].splitlines(), [said[0].rpartition("/")[2], *said[1:]], strict=True
        ):
            number = r"-?\d+(?:\.\d+)?"
            assert re.sub(number, "#", line) == re.sub(number, "#", expected)
            figures, right = (list(map(float, re.findall(number, text))) for text in (line, expected))
            assert figures == pytest.approx(right, rel=2e-3, abs=0.06), name
    row = re.search(r"^\| CWRU DE 105 .*$", (DOCS / "docs/race-test.md").read_text(), re.MULTILINE)
    for z, size in re.findall(r"z (\S+) size (\S+?),?(?:\s|$)", said[1]):
        assert f"{z} / {size}" in row[0]
