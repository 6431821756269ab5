"""What the views make of samples, against arithmetic of their own."""

from __future__ import annotations

import base64
import json
import time
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from daqsvc.history.file import HistoryFile, Series
from daqsvc.history.points import RECORD
from daqsvc.page.charts import LIGHT
from daqsvc.page.lines import amplitudes
from daqsvc.page.machine_live import MachineLive
from daqsvc.page.presence import Picture
from daqsvc.page.shaft import order_1x, whirl
from daqsvc.page.text import alarm_rows
from daqsvc.page.views.all_views import VIEWS
from daqsvc.page.views.timebase import thinned
from daqsvc.page.views.trend import MOST_POINTS

if TYPE_CHECKING:
    from pathlib import Path

RATE_HZ = 1000.0
SPEED_HZ = 12.3
ANGLES = (45.0, 135.0)


def machine_values(**machine: Any) -> dict[str, Any]:
    probes = [
        {"name": name, "type": "proximity", "unit": "um", "angle_deg": angle}
        for name, angle in zip(("left", "right"), ANGLES, strict=True)
    ]
    key = {"name": "key", "type": "keyphasor", "unit": "V", "threshold_v": -6.0}
    return {"machine": {"name": "rig", "speed_rpm": 60.0 * SPEED_HZ, **machine}, "sensors": [*probes, key]}


def about(**machine: Any) -> dict[str, Any]:
    facts = {
        "rate_hz": RATE_HZ,
        "channels": ["a", "b", "c"],
        "sensors": ["left", "right", "key"],
        "units": ["um", "um", "V"],
    }
    return {
        "values": machine_values(**machine),
        "machine": "rig",
        "wall_ns_at_0": 0,
        "begun_ns": 0,
        "streams": {"shaft": facts},
        "statements": [],
        "alarms": [],
        "standings": {},
    }


def told(rows: Any, first_index: int = 0) -> dict[str, Any]:
    rows = np.asarray(rows, "<f4")
    return {
        "samples": {
            "stream": "shaft",
            "first_index": first_index,
            "t_first_ns": first_index * 1_000_000,
            "period_ns": 1e6,
            "lost_before": 0,
            "quality": 0,
            "shape": list(rows.shape),
            "values": base64.b64encode(rows.tobytes()).decode(),
        }
    }


def turning(seconds: float, x: complex, y: complex) -> np.ndarray[Any, Any]:
    """Samples of the probes and the keyphasor of a shaft whose centre moves so, ``[n, 3]``."""
    turns = np.arange(round(seconds * RATE_HZ)) / RATE_HZ * SPEED_HZ + 0.37
    wave = np.exp(2j * np.pi * turns)
    position = np.array([(x * wave).real + 3.0, (y * wave).real - 7.0])
    probes = [np.cos(a) * position[0] + np.sin(a) * position[1] for a in np.radians(ANGLES)]
    return np.column_stack([*probes, np.where(turns % 1.0 < 0.06, -2.0, -10.0)])


def test_the_order_1x_of_a_whirl_is_found_with_its_phase_behind_the_mark() -> None:
    live = MachineLive(about())
    x, y = 20.0 * np.exp(-0.5j), 11.0 * np.exp(1.2j)
    live.hear(told(turning(3.0, x, y)))
    seen = whirl(live, ("left", "right"), 20.0)
    assert seen is not None
    assert seen.has_keyphasor
    order = order_1x(seen)
    assert order is not None
    assert order.mean_um == pytest.approx([3.0, -7.0], abs=0.1)
    assert np.abs(order.vectors_um - [x, y]).max() < 0.6, "a sample is 4 degrees"
    ellipse = order.ellipse_um()
    assert ellipse[0] == pytest.approx(ellipse[-1])
    assert np.ptp(ellipse[:, 0]) == pytest.approx(40.0, rel=0.02)


def test_samples_that_are_told_again_are_not_there_twice_and_a_gap_is_seen() -> None:
    live = MachineLive(about())
    rows = turning(1.0, 20.0, -20.0j)
    live.hear(told(rows[:600]))
    live.hear(told(rows[500:900], 500))
    live.hear(told(rows[100:200], 100))
    newest = live.newest("shaft", 0.9)
    assert newest is not None
    assert np.array_equal(newest[0], rows[:900].astype(np.float32))
    assert newest[1] == 899_000_000
    live.hear(told(rows[950:], 950))
    newest = live.newest("shaft", 0.1)
    assert newest is not None
    assert np.isnan(newest[0]).all(axis=1).tolist() == [True] * 50 + [False] * 50
    again = MachineLive(about())
    again.go_on_from(live)
    assert again.newest("shaft", 0.1) is not None
    anew = MachineLive({**about(), "begun_ns": 5})
    anew.go_on_from(live)
    assert anew.newest("shaft", 0.1) is None, "the service counts from 0 again"


def test_lines_of_a_spectrum_have_the_amplitudes_of_their_waves() -> None:
    t = np.arange(2000) / RATE_HZ
    values = 5.0 + 3.0 * np.cos(2 * np.pi * 50.0 * t) + 0.5 * np.cos(2 * np.pi * 120.0 * t + 1.0)
    lines = 2.0 * amplitudes(values)
    assert lines[100] == pytest.approx(3.0, rel=1e-3)
    assert lines[240] == pytest.approx(0.5, rel=1e-3)
    assert lines[0] < 0.01, "the mean is no vibration"
    values[300:500] = np.nan
    assert 2.0 * amplitudes(values)[100] == pytest.approx(3.0, rel=0.02)


def test_forward_and_backward_whirl_are_told_apart() -> None:
    live = MachineLive(about())
    live.hear(told(turning(8.0, 20.0, -20.0j)))  # x leads y: it turns anticlockwise
    shown = VIEWS["full-spectrum"].shown(live, {"probes": "left,right", "revolutions": "80"})
    rows = {name: float(value) for name, value, _ in shown.rows}
    assert rows["1X forward"] == pytest.approx(20.0, rel=0.05)
    assert rows["1X backward"] < 0.5
    # Seen from the other end the same shaft turns clockwise, and its whirl is forward all the same.
    clockwise = MachineLive(about(rotation="clockwise"))
    clockwise.hear(told(turning(8.0, 20.0, 20.0j)))
    shown = VIEWS["full-spectrum"].shown(clockwise, {"probes": "left,right", "revolutions": "80"})
    assert float({r[0]: r[1] for r in shown.rows}["1X forward"]) == pytest.approx(20.0, rel=0.05)


def test_a_thinned_line_keeps_every_extreme() -> None:
    values = np.random.default_rng(1).normal(size=50_000)
    values[12_345], values[40_000] = 9.0, -9.0
    t, kept = thinned(np.arange(50_000.0), values)
    assert len(kept) <= 2100
    assert (np.diff(t) > 0).all() or (np.diff(t) >= 0).all()
    assert {9.0, -9.0} <= {*kept}
    holes = values.copy()
    holes[1000:1400] = np.nan
    assert np.isnan(thinned(np.arange(50_000.0), holes)[1]).any()


def test_a_machine_without_pairs_of_probes_has_no_orbit_and_says_why() -> None:
    live = MachineLive(about())
    live.sensors = {name: one._replace(angle_deg=0.0) for name, one in live.sensors.items()}
    assert "60 to 120 degrees apart" in VIEWS["orbit"].why_not(live)
    assert VIEWS["timebase"].why_not(live) == ""


def test_what_an_alarm_says_is_text_and_no_markup() -> None:
    alarm = {
        "alarm": "a<b>",
        "state": "active_unacknowledged",
        "level": "alert",
        "first_out": False,
        "wall_ns": 1_795_000_000_000_000_000,
        "monotonic_ns": 1,
        "message": "<script>alert(1)</script> & so on",
    }
    html = alarm_rows(MachineLive({**about(), "alarms": [alarm]}))
    assert "<script" not in html
    assert "a&lt;b&gt;" in html
    assert "&amp; so on" in html


def test_a_damaged_bearing_shows_in_the_envelope_at_its_lines() -> None:
    rate_hz, speed_hz, order = 12_000.0, 25.0, 3.585
    t = np.arange(round(4.0 * rate_hz)) / rate_hz
    struck = (t * order * speed_hz) % 1.0 / (order * speed_hz)
    rng = np.random.default_rng(3)
    values = 5.0 * np.exp(-struck * 900.0) * np.sin(2.0 * np.pi * 3000.0 * struck) + rng.normal(size=len(t))
    facts = {"rate_hz": rate_hz, "channels": ["a"], "sensors": ["casing"], "units": ["m/s2"]}
    bearing = {"name": "drive-end", "type": "6205-2RS"}
    live = MachineLive(
        {
            **about(speed_rpm=60.0 * speed_hz),
            "values": {
                "machine": {"name": "rig", "speed_rpm": 60.0 * speed_hz},
                "sensors": [{"name": "casing", "type": "accelerometer", "unit": "m/s2"}],
                "pipeline": {"bearing": {"bearings": [bearing]}},
            },
            "streams": {"housing": facts},
        }
    )
    samples = told(values[:, None])["samples"]
    live.hear({"samples": {**samples, "stream": "housing", "period_ns": 1e9 / rate_hz}})
    view = VIEWS["envelope"]
    assert view.why_not(live) == ""
    shown = view.shown(live, {"sensor": "casing", "length": "2"})
    rows = {name.partition(",")[0]: float(value) for name, value, _ in shown.rows}
    assert rows["drive-end BPFO"] > 2.5 * rows["drive-end BPFI"]
    largest = next((name, float(value)) for name, value, _ in shown.rows if name.startswith("largest"))
    assert largest[1] == rows["drive-end BPFO"]
    assert float(largest[0].split()[2]) == pytest.approx(order * speed_hz, abs=0.5)
    lines = shown.sources["bearing_lines"]
    assert lines["x"][lines["name"].index("drive-end BPFO")] == pytest.approx(order * speed_hz, rel=1e-3)
    slow = MachineLive(about())
    assert "2000 Hz or faster" in view.why_not(slow)


def test_a_trend_is_drawn_from_the_history_and_broken_where_nothing_was_measured(tmp_path: Path) -> None:
    live = MachineLive(about())
    view = VIEWS["trend"]
    assert "no history of this machine is stored" in view.why_not(live)
    live.history = tmp_path / "history.sqlite"
    assert "no history of this machine is stored" in view.why_not(live)
    now_s = int(time.time())
    series = Series("rig", "levels/left", "statistic", "rms", "um")
    seconds = np.array(
        [(now_s - 3000 + k, 1, 4.0, 5.0, 7.0) for k in range(2900) if not 1000 <= k < 1400], RECORD
    )
    file = HistoryFile(live.history)
    file.write({series: seconds})
    file.close()
    assert view.why_not(live) == ""
    assert view.choices(live)[0].options == {"levels/left.rms": "levels/left.rms"}
    shown = view.shown(live, {"reading": "levels/left.rms", "hours": "1"})
    drawn = shown.sources["trend"]
    assert len(drawn["t"]) <= MOST_POINTS
    assert drawn["t"][0] == pytest.approx(-3000 / 60, abs=0.6), "minutes"
    assert np.nanmin(drawn["mean"]) == np.nanmax(drawn["mean"]) == 5.0
    hole = drawn["t"][np.isnan(drawn["mean"])]
    assert (hole.min(), hole.max()) == pytest.approx((-2000 / 60, -1600 / 60), abs=0.6)
    assert {row[0]: row[1] for row in shown.rows}["mean"] == "5"
    by_the_hour = view.shown(live, {"reading": "levels/left.rms", "hours": "8760"})
    assert ("mean", "5", "um") in by_the_hour.rows
    assert len(by_the_hour.sources["trend"]["t"]) <= 2


def test_a_trend_begins_with_a_figure_that_has_limits_and_draws_them(tmp_path: Path) -> None:
    live = MachineLive(about())
    alarm = {"name": "a", "sensor": "left", "measure": "velocity_rms", "alert": 2.8, "danger": 4.5}
    live.values = live.values | {"alarms": [alarm]}
    live.history = tmp_path / "history.sqlite"
    file = HistoryFile(live.history)
    second = np.array([(int(time.time()) - 60, 1, 4.0, 5.0, 7.0)], RECORD)
    for key in ("rms", "velocity_rms", "peak"):
        file.write({Series("rig", "levels/left", "statistic", key, "mm/s"): second})
    file.close()
    view = VIEWS["trend"]
    reading, *others = view.choices(live)[0].options
    assert (reading, others) == ("levels/left.velocity_rms", ["levels/left.rms", "levels/left.peak"])

    def drawn(reading: str, hours: str) -> tuple[set[str], str]:
        [figure] = view.figures(live, {"reading": reading, "hours": hours}, LIGHT)
        items = {item.label.value for item in figure.made.legend[0].items}
        return items, figure.made.xaxis[0].axis_label

    assert drawn(reading, "0.25") == ({reading, "alert", "danger"}, "time before now, minutes")
    assert drawn("levels/left.rms", "8") == ({"levels/left.rms"}, "time before now, hours")


def test_the_centreline_follows_the_means_of_both_probes() -> None:
    live = MachineLive(about())
    view = VIEWS["centreline"]
    assert "pipeline.levels" in view.why_not(live)
    for second in range(5):
        for name, angle in zip(("left", "right"), np.radians(ANGLES), strict=True):
            mean = 10.0 * second * np.cos(angle) + 4.0 * np.sin(angle)
            said = {
                "detector": f"levels/{name}",
                "monotonic_ns": second * 1_000_000_000 + (name == "right") * 1000,
                "decision": "normal",
                "probabilities": {},
                "statistics": {"mean": mean},
                "units": {"mean": "um"},
            }
            live.hear({"statement": said})
    assert view.why_not(live) == ""
    shown = view.shown(live, {"probes": "left,right", "minutes": "1"})
    assert shown.sources["centreline"]["x"] == pytest.approx([0.0, 10.0, 20.0, 30.0, 40.0])
    assert shown.sources["centreline"]["y"] == pytest.approx([4.0] * 5)
    assert ("moved since the first", "40.0", "um") in shown.rows


def test_a_whirl_that_repeats_is_one_point_of_the_poincare_map() -> None:
    live = MachineLive(about())
    live.hear(told(turning(8.0, 20.0, -20.0j)))
    shown = VIEWS["poincare"].shown(live, {"probes": "left,right", "revolutions": "20"})
    spread = {name: float(value) for name, value, _ in shown.rows}
    assert 19 <= spread["revolutions"] <= 20
    assert max(spread["spread of x"], spread["spread of y"]) < 1.0
    twice = MachineLive(about())
    rows = turning(8.0, 20.0, -20.0j)
    half = np.arange(len(rows)) / RATE_HZ * SPEED_HZ * np.pi
    rows[:, 0] += 15.0 * np.cos(half)
    twice.hear(told(rows))
    shown = VIEWS["poincare"].shown(twice, {"probes": "left,right", "revolutions": "20"})
    assert np.ptp(shown.sources["poincare"]["x"]) > 6.0, "half the speed makes two clouds of it"


async def test_a_view_that_fails_is_said_and_the_others_go_on(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    live = MachineLive(about())
    heard = SimpleNamespace(live=live, why_not="", heard_s=time.monotonic())
    broken, whole = (
        Picture(None, "rig", VIEWS[name], chosen)  # type: ignore[arg-type]
        for name, chosen in (
            ("orbit", {"probes": "left,right", "revolutions": "4"}),
            ("timebase", {"sensor": "gone", "length": "1"}),
        )
    )
    monkeypatch.setattr(type(VIEWS["orbit"]), "shown", lambda *_: 1 / 0)
    for _ in range(2):
        assert json.loads(broken._whatever(heard))["why"].startswith("the page has failed")  # type: ignore[arg-type]
    assert len(caplog.records) == 1
    note = json.loads(whole._whatever(heard))["note"]  # type: ignore[arg-type]
    assert note.startswith("gone is not there any more")


@pytest.mark.parametrize("spoilt", ["a mark is missing", "a mark too many"])
def test_a_mark_that_is_missing_or_too_many_leaves_1x_as_it_is(spoilt: str) -> None:
    live = MachineLive(about())
    rows = turning(3.0, 20.0, -20.0j)
    pulses = np.flatnonzero((rows[1:, 2] > -6.0) & (rows[:-1, 2] <= -6.0)) + 1
    at = pulses[-3]
    if spoilt == "a mark is missing":
        rows[at - 2 : at + 8] = np.nan
    else:
        rows[at + 30 : at + 33, 2] = -2.0
    live.hear(told(rows))
    seen = whirl(live, ("left", "right"), 8.0)
    assert seen is not None
    order = order_1x(seen)
    assert order is not None
    assert np.abs(order.vectors_um) == pytest.approx([20.0, 20.0], rel=0.03)


def test_the_hysteresis_of_the_machine_file_counts() -> None:
    values = machine_values()
    values["sensors"][2]["hysteresis_v"] = 3.0
    live = MachineLive({**about(), "values": values})
    rows = turning(3.0, 20.0, -20.0j)
    noise = np.random.default_rng(2).normal(scale=0.8, size=len(rows))
    live.hear(told(np.column_stack([rows[:, :2], rows[:, 2] + noise])))
    seen = whirl(live, ("left", "right"), 16.0)
    assert seen is not None
    assert 15 <= len(seen.marks) <= 16


def probes_named(*names: str, pipeline: dict[str, Any] | None = None) -> list[tuple[str, str]]:
    sensors = [
        {"name": name, "type": "proximity", "unit": "um", "angle_deg": 45.0 if "x" in name else 135.0}
        for name in names
    ]
    facts = {"rate_hz": 1.0, "channels": [*names], "sensors": [*names], "units": ["um"] * len(names)}
    values = {"machine": {"name": "rig"}, "sensors": sensors, "pipeline": pipeline or {}}
    return MachineLive({**about(), "values": values, "streams": {"s": facts}}).probes()


def test_probes_of_two_planes_make_no_pair() -> None:
    two = [("de-x", "de-y"), ("nde-x", "nde-y")]
    assert probes_named("de-x", "de-y", "nde-x", "nde-y") == two
    assert probes_named("de-x", "nde-x", "de-y", "nde-y") == two
    bank = {"rotor_bank": {"probes": ["x2", "y1"]}, "levels": {"window_s": 1.0}}
    assert probes_named("x1", "x2", "y1", "y2", pipeline=bank) == [("x2", "y1"), ("x1", "y2")]


def test_a_stream_that_comes_no_more_is_told_with_its_age(monkeypatch: pytest.MonkeyPatch) -> None:
    live = MachineLive(about())
    chosen = {"sensor": "left", "length": "1"}
    heard = SimpleNamespace(live=live, why_not="", heard_s=time.monotonic() + 1e6)
    picture = Picture(None, "rig", VIEWS["timebase"], chosen)  # type: ignore[arg-type]
    live.hear(told(turning(1.0, 20.0, -20.0j)))
    assert json.loads(picture._whatever(heard))["why"] == ""  # type: ignore[arg-type]
    now_s = time.monotonic()
    with monkeypatch.context() as later:
        later.setattr(time, "monotonic", lambda: now_s + 30.0)
        said = json.loads(picture._whatever(heard))  # type: ignore[arg-type]
    assert said["why"] == "nothing comes from shaft any more"
    assert said["age_s"] == pytest.approx(30.0, abs=0.5)
    live.hear({"standing": {"stream": "shaft", "doubt": "", "proven": True, "silent": True}})
    assert json.loads(picture._whatever(heard))["why"], "so says the service, too"  # type: ignore[arg-type]


def test_a_speed_that_nobody_has_measured_is_called_nominal() -> None:
    live = MachineLive(about())
    assert live.speed_in_words == "738 rpm nominal"
    said = {"detector": "bank", "monotonic_ns": 1, "decision": "N", "probabilities": {}}
    live.hear({"statement": {**said, "statistics": {"speed": 741.0}, "units": {"speed": "rpm"}}})
    assert live.speed_in_words == "741 rpm"
