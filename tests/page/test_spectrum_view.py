"""The spectrum with its cursors, axes and quantities, against closed forms."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from test_views import RATE_HZ, SPEED_HZ, about, told

from daqsvc.page.bearing_lines import bearing_lines
from daqsvc.page.charts import DARK, LIGHT, stroke
from daqsvc.page.machine_live import MachineLive
from daqsvc.page.views.all_views import VIEWS

if TYPE_CHECKING:
    from daqsvc.page.views.view import Shown

VIEW = VIEWS["spectrum"]
CHOSEN = {
    "sensor": "casing",
    "length": "2",
    "cursors": "1X to 3X",
    "axis": "hz",
    "amplitude": "peak",
    "scale": "linear",
    "quantity": "own",
}
BPFO = 3.05
TONE_HZ = 120.5


def looking(rate_hz: float = RATE_HZ) -> MachineLive:
    """A casing whose accelerometer sees 1X of 2 g, a bearing line of .5 g, and a tone of .3 g."""
    known = about()
    known["streams"] = {
        "shaft": {"rate_hz": rate_hz, "channels": ["a"], "sensors": ["casing"], "units": ["g"]}
    }
    orders = {"bpfi": 4.575, "bpfo": BPFO, "bsf": 2.0, "ftf": 0.4}
    bearing = {"name": "drive end", "sensor": "casing", "orders": orders}
    known["values"] |= {
        "sensors": [{"name": "casing", "type": "accelerometer", "unit": "g"}],
        "pipeline": {"bearing": {"bearings": [bearing]}},
    }
    live = MachineLive(known)
    t = np.arange(round(3.0 * rate_hz)) / rate_hz
    waves = ((2.0, SPEED_HZ), (0.5, BPFO * SPEED_HZ), (0.3, TONE_HZ))
    live.hear(told(sum(size * np.cos(2 * np.pi * at * t) for size, at in waves)[:, None]))  # type: ignore[index]
    return live


def shown(**others: str) -> Shown:
    return VIEW.shown(looking(), CHOSEN | others)


def row(made: Shown, begins: str) -> tuple[float, str]:
    [(_, value, unit)] = [one for one in made.rows if one[0].startswith(begins)]
    return float(value), unit


def test_orders_are_marked_and_measured() -> None:
    made = shown()
    assert row(made, "1X at 12.30 Hz") == (pytest.approx(2.0, rel=0.01), "g peak")
    assert made.sources["orders"]["x"] == pytest.approx([SPEED_HZ, 2 * SPEED_HZ, 3 * SPEED_HZ])
    assert len(shown(cursors="1X to 10X").sources["orders"]["x"]) == 10
    assert shown(cursors="fractions of 1X").sources["orders"]["x"][2] == pytest.approx(SPEED_HZ / 2.0)


def test_a_bearing_line_and_its_harmonics_are_marked_at_the_speed_of_now() -> None:
    offered = {choice.name: choice.options for choice in VIEW.choices(looking())}
    assert "drive end BPFO" in offered["cursors"]
    made = shown(cursors="drive end BPFO")
    assert made.sources["orders"]["x"] == pytest.approx([n * BPFO * SPEED_HZ for n in (1, 2, 3)])
    assert row(made, "drive end BPFO")[0] == pytest.approx(0.5, rel=0.02)


def test_by_order_the_line_and_the_cursors_lie_at_multiples_of_the_speed() -> None:
    made = shown(axis="order")
    assert made.sources["orders"]["x"] == pytest.approx([1.0, 2.0, 3.0])
    lines = made.sources["spectrum"]
    assert lines["x"][np.argmax(lines["a"])] == pytest.approx(1.0, abs=0.05)
    assert lines["o"] == pytest.approx(lines["f"] / SPEED_HZ)
    assert row(made, "that is order")[0] == pytest.approx(1.0, abs=0.05)


@pytest.mark.parametrize(
    ("amplitude", "factor", "words"), [("pp", 2.0, "peak to peak"), ("rms", 0.70711, "r.m.s.")]
)
def test_amplitudes_are_of_the_kind_that_is_asked_for(amplitude: str, factor: float, words: str) -> None:
    made = shown(amplitude=amplitude)
    assert row(made, "1X at") == (pytest.approx(2.0 * factor, rel=0.01), f"g {words}")
    rms = np.sqrt((2.0**2 + 0.5**2 + 0.3**2) / 2.0)
    assert row(made, "overall") == (pytest.approx(rms, rel=0.02), "g r.m.s.")


def test_the_velocity_of_an_accelerometer_is_its_integral() -> None:
    made = shown(quantity="velocity", amplitude="rms")
    mm_s = 2.0 * 9806.65 / (2.0 * np.pi * SPEED_HZ) / np.sqrt(2.0)
    assert row(made, "1X at") == (pytest.approx(mm_s, rel=0.01), "mm/s r.m.s.")
    assert row(made, "overall")[1] == "mm/s r.m.s."
    assert made.sources["spectrum"]["a"][made.sources["spectrum"]["f"] < 2.0].max() == 0.0


def test_lines_of_a_bearing_come_of_its_orders_its_dimensions_or_the_catalogue() -> None:
    live = looking()
    told = [dict(bearing_lines(live, ""))]
    size = {"balls": 9, "ball_diameter_mm": 7.94, "pitch_diameter_mm": 39.04}
    for key, one in (("geometry", size), ("type", "6205-2RS")):
        live.values["pipeline"]["bearing"]["bearings"] = [{"name": "drive end", "sensor": "casing", key: one}]
        told.append(dict(bearing_lines(live, "casing")))
    assert told[0]["drive end BPFO"] == BPFO
    assert told[1] == pytest.approx(told[2], rel=1e-3)
    assert told[1]["drive end BPFO"] == pytest.approx(3.585, abs=1e-3)
    assert dict(bearing_lines(live, "another")) == {}


def test_figures_are_made_of_every_choice() -> None:
    live = looking()
    for choice in VIEW.choices(live):
        for value in choice.options:
            [figure] = VIEW.figures(live, CHOSEN | {choice.name: value}, LIGHT)
            assert figure.made.select({"name": "spectrum"})


def test_a_trend_value_of_one_hertz_has_no_spectrum() -> None:
    live = looking(rate_hz=1.0)
    assert "fast enough" in VIEW.why_not(live)
    assert "fast enough" in VIEWS["waterfall"].why_not(live)


def test_no_two_of_twelve_modes_are_drawn_alike() -> None:
    for theme in (LIGHT, DARK):
        drawn: list[Any] = [tuple(stroke(theme, number).items()) for number in range(18)]
        assert len(set(drawn)) == 18
