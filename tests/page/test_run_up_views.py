"""Run-ups in the page, against the closed form of a rotor: Bode, polar, waterfall and cascade."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from test_views import ANGLES, RATE_HZ, about, told

from daqsvc.page.machine_live import MachineLive
from daqsvc.page.runs import MOST_SPECTRA
from daqsvc.page.views.all_views import VIEWS
from daqsvc.page.views.run_up import critical_speed

NATURAL_HZ, ZETA, ECCENTRICITY_UM = 15.0, 0.05, 4.0
RUN_OUT = 3.0 * np.exp(1j * np.radians(135.0))
CHOSEN = {"sensor": "left", "amplitude": "peak", "compensation": "none"}
RUN_S = 60.0


def response(speed_hz: Any) -> Any:
    """Whirl of a Laval rotor by its unbalance: amplitude, and lag as a negative angle."""
    ratio = speed_hz / NATURAL_HZ
    return ECCENTRICITY_UM * ratio**2 / (1.0 - ratio**2 + 2j * ZETA * ratio)


def pulses(turns: Any) -> Any:
    """Of a keyphasor whose mark comes with whole turns; a slope, so that it lies between samples."""
    behind = (turns + 0.5) % 1.0 - 0.5
    return -10.0 + 8.0 * np.clip(0.5 + behind / 0.2, 0.0, 1.0) * (behind < 0.15)


def run_up(seconds: float = RUN_S, run_out: complex = 0.0) -> np.ndarray[Any, Any]:
    """Samples ``[n, 3]`` while the speed rises from 5 to 30 Hz, so slowly that the rotor follows."""
    t = np.arange(round(seconds * RATE_HZ)) / RATE_HZ
    speed_hz = 5.0 + 25.0 * t / seconds
    turns = 5.0 * t + 12.5 * t**2 / seconds + 0.2
    wave = np.exp(2j * np.pi * turns)
    whirl = response(speed_hz)
    probes = [((whirl * np.exp(-1j * np.radians(one)) + run_out) * wave).real - 5.0 for one in ANGLES]
    return np.column_stack([*probes, pulses(turns)])


def looked_at(
    samples: np.ndarray[Any, Any], view: str, step_s: float = 3.0, **chosen: str
) -> tuple[Any, MachineLive]:
    """What a view shows at the end, if it was looked at all the time."""
    live, step = MachineLive(about()), round(step_s * RATE_HZ)
    shown = None
    for first in range(0, len(samples), step):
        live.hear(told(samples[first : first + step], first))
        shown = VIEWS[view].shown(live, CHOSEN | chosen)
    return shown, live


def rows(shown: Any) -> dict[str, float]:
    return {name: float(value) for name, value, _ in shown.rows}


def test_a_run_up_has_the_amplitudes_lags_and_critical_speed_of_the_rotor() -> None:
    shown, live = looked_at(run_up(), "bode")
    seen = live.vectors_of("left")
    assert len(seen.t_ns) == pytest.approx(RUN_S * 17.5 / 4.0, abs=1), "each revolution once, none twice"
    assert (np.diff(seen.t_ns) > 0).all()
    expected = response(seen.speed_rpm / 60.0) * np.exp(-1j * np.radians(ANGLES[0]))
    # Over four revolutions the speed changes by up to half a percent, and the lag by some degrees.
    assert np.abs(seen.vectors - expected).max() < 0.05 * ECCENTRICITY_UM / (2.0 * ZETA)
    told = rows(shown)
    assert told["critical speed"] == pytest.approx(60.0 * NATURAL_HZ, rel=0.02)
    assert told["1X there"] == pytest.approx(ECCENTRICITY_UM / (2.0 * ZETA), rel=0.05)
    assert told["amplification factor"] == pytest.approx(1.0 / (2.0 * ZETA), rel=0.12)
    assert shown.note == ""
    at = int(np.abs(seen.speed_rpm / 60.0 - NATURAL_HZ).argmin())
    lag = float(shown.sources["run"]["p"][at])
    assert lag == pytest.approx(90.0 + ANGLES[0], abs=12.0), "and the probe's angle"
    assert (np.diff(np.unwrap(np.radians(shown.sources["run"]["p"]))) > -0.3).all()


def test_peak_to_peak_is_twice_the_peak_and_slow_roll_takes_the_run_out_away() -> None:
    samples = run_up(run_out=complex(RUN_OUT))
    plain, _ = looked_at(samples, "bode")
    twice, _ = looked_at(samples, "bode", amplitude="pp")
    assert rows(twice)["1X there"] == pytest.approx(2.0 * rows(plain)["1X there"], rel=1e-3)
    less, live = looked_at(samples, "bode", compensation="slow-roll")
    fast = live.vectors_of("left").speed_rpm > 60.0 * 22.0
    wanted = np.abs(response(live.vectors_of("left").speed_rpm[fast] / 60.0) - response(5.0))
    assert np.abs(np.asarray(less.sources["run"]["a"])[fast] - wanted).max() < 1.0
    assert np.abs(np.asarray(plain.sources["run"]["a"])[fast] - wanted).max() > 2.0


def test_the_polar_plot_turns_the_lag_against_the_shaft_from_the_probe() -> None:
    shown, live = looked_at(run_up(), "polar")
    seen, run = live.vectors_of("left"), shown.sources["run"]
    at = int(np.abs(seen.speed_rpm / 60.0 - NATURAL_HZ).argmin())
    # The high spot is 90 degrees behind the heavy spot, which was at the mark: at -90 degrees.
    angle = np.degrees(np.angle(run["x"][at] + 1j * run["y"][at]))
    assert angle == pytest.approx(-90.0, abs=12.0)
    assert np.hypot(run["x"][at], run["y"][at]) == pytest.approx(ECCENTRICITY_UM / (2.0 * ZETA), rel=0.06)


def test_a_machine_at_one_speed_says_so() -> None:
    t = np.arange(5000) / RATE_HZ
    turns = 10.0 * t + 0.2
    steady = np.column_stack([np.cos(2 * np.pi * turns)] * 2 + [pulses(turns)])
    shown, _ = looked_at(steady, "bode")
    assert "the speed has hardly changed in the last" in shown.note
    assert "critical speed" not in rows(shown)
    assert rows(shown)["1X now"] == pytest.approx(1.0, abs=0.02)
    assert (
        VIEWS["bode"].shown(MachineLive(about()), CHOSEN).note
        == "too few whole revolutions of this sensor have come yet"
    )


def test_a_missing_mark_and_a_gap_make_no_revolution() -> None:
    samples = run_up(20.0)
    _, whole = looked_at(samples, "bode", step_s=20.0)
    seen_whole = whole.vectors_of("left")
    begins = np.flatnonzero((samples[1:, 2] > -6.0) & (samples[:-1, 2] <= -6.0)) + 1
    samples[begins[40] - 10 : begins[40] + 20, 2] = -10.0
    samples[begins[60] : begins[64], 0] = np.nan
    _, live = looked_at(samples, "bode", step_s=20.0)
    seen = live.vectors_of("left")
    assert len(seen_whole.t_ns) - 4 <= len(seen.t_ns) < len(seen_whole.t_ns) - 1
    assert (np.diff(seen.speed_rpm) > 0.0).all(), "the speed only rises"


def test_what_has_no_peak_inside_has_no_critical_speed() -> None:
    speed = np.linspace(300.0, 600.0, 200)
    assert critical_speed(speed, np.abs(response(speed / 60.0))) is None
    passed = critical_speed(
        np.linspace(300.0, 910.0, 400), np.abs(response(np.linspace(300.0, 910.0, 400) / 60.0))
    )
    assert passed is None or passed.q is None, "the half-power point beyond it was not passed"


def test_a_waterfall_holds_the_lines_of_each_time_and_a_cascade_those_of_each_speed() -> None:
    chosen = {"over": "time", "window": "1"}
    live = MachineLive(about())
    samples = run_up()
    for first in range(0, len(samples), 2000):
        live.hear(told(samples[first : first + 2000], first))
        speed_rpm = 60.0 * (5.0 + 25.0 * first / len(samples))
        live.values["machine"]["speed_rpm"] = speed_rpm
        shown = VIEWS["waterfall"].shown(live, CHOSEN | chosen)
    spectra = live.spectra_of("left", 1.0)
    assert len(spectra) == 60
    for number in (5, 30, 50):
        strongest = spectra[number].frequency_hz[spectra[number].peak.argmax()]
        assert strongest == pytest.approx(5.0 + 25.0 * (number + 0.5) / 60.0, abs=1.0)
    assert (np.diff([one.t_ns for one in spectra]) == 1_000_000_000).all()
    z = np.asarray(shown.sources["waterfall"]["z"])
    assert np.nanmax(z) == 0.0
    assert np.nanmin(z) == -59.0
    assert len({*z[np.isfinite(z)]}) == 60
    cascade = VIEWS["waterfall"].shown(live, CHOSEN | chosen | {"over": "speed"})
    z = np.asarray(cascade.sources["waterfall"]["z"])
    assert np.nanmin(z) == pytest.approx(300.0)
    assert np.nanmax(z) == pytest.approx(60.0 * (5.0 + 25.0 * 58.0 / 60.0))
    for first in range(len(samples), len(samples) + 200_000, 2000):
        live.hear(told(samples[:2000], first))
        VIEWS["waterfall"].shown(live, CHOSEN | chosen)
    assert len(live.spectra_of("left", 1.0)) == MOST_SPECTRA
