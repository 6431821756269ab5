"""The race test as a whole: simulated bearings, bad input, and the watch on a running machine."""

from __future__ import annotations

import numpy as np
import pytest
from support.race_signals import BEARING, RATE_HZ, SPEED_RPM, strikes

from daqsvc.bearing.geometry import bearing_orders
from daqsvc.bearing.race import RaceWatch, race_baseline, race_test
from daqsvc.dsp.quality import UnfitError


def judge(samples: np.ndarray, **changes: object) -> object:
    arguments = {"rate_hz": RATE_HZ, "speed_rpm": SPEED_RPM, "bearing": BEARING} | changes
    return race_test(samples, **arguments)


@pytest.mark.parametrize("seed", [0, 1, 2])
@pytest.mark.parametrize("part", ["inner", "outer", "ball"])
@pytest.mark.parametrize("rate_hz", [12_000.0, 25_600.0])
def test_each_part_is_named(part: str, seed: int, rate_hz: float) -> None:
    v = judge(strikes(part, strength=1.5, seed=seed, rate_hz=rate_hz), rate_hz=rate_hz)
    assert v.verdict == part
    assert v.group == (part,)
    assert max(v.probability, key=v.probability.get) == part
    assert v.evidence[part].z > 10.0


@pytest.mark.parametrize("seed", range(5))
def test_a_bearing_in_good_order_is_normal(seed: int) -> None:
    v = judge(strikes(None, seed=seed))
    assert v.verdict == "normal"
    assert v.lines == () or v.lines[0].depth < 0.2


@pytest.mark.parametrize("scale", [1e-6, 9.81, 1e6])
def test_the_unit_does_not_matter(scale: float) -> None:
    samples = strikes("inner")
    assert judge(scale * samples).evidence["inner"].z == pytest.approx(
        judge(samples).evidence["inner"].z, 1e-3
    )


@pytest.mark.parametrize("error", [-0.01, 0.01])
def test_a_speed_wrong_by_one_percent_is_put_right(error: float) -> None:
    v = judge(strikes("outer"), speed_rpm=(1.0 + error) * SPEED_RPM)
    assert v.verdict == "outer"
    assert v.speed_rpm == pytest.approx(SPEED_RPM, rel=1e-3)


def test_the_lines_are_where_the_strikes_are() -> None:
    v = judge(strikes("outer"))
    line = v.lines[0]
    assert line.part == "outer"
    assert line.order == pytest.approx(line.harmonic * BEARING.outer, rel=0.01)
    assert line.frequency_hz == pytest.approx(line.order * v.speed_rpm / 60.0)
    assert v.spectrum.order[np.argmax(v.spectrum.amplitude[60:]) + 60] == pytest.approx(line.order, rel=0.02)


def test_a_ball_near_a_harmonic_of_the_shaft_is_said_to_be_not_testable() -> None:
    v = judge(strikes(None), bearing=bearing_orders("6203"))
    assert not v.evidence["ball"].testable
    assert any("ball not testable here: 2 BSF = 3.98" in note for note in v.notes)
    assert judge(strikes(None)).evidence["ball"].testable


def test_an_unconfirmed_speed_is_noted_and_needs_more() -> None:
    noise = np.random.default_rng(3).standard_normal(30_000)
    v = judge(noise)
    assert not v.speed_seen
    assert any("no harmonics of the shaft" in note for note in v.notes)
    assert v.evidence["outer"].limit == 2.0 * judge(strikes(None)).evidence["outer"].limit


def test_with_a_baseline_a_change_is_told_from_good_order() -> None:
    baseline = race_baseline(strikes(None, seed=1), RATE_HZ, SPEED_RPM, BEARING)
    assert judge(strikes(None, seed=2), baseline=baseline).verdict == "normal"
    louder = judge(1.6 * strikes(None, seed=2), baseline=baseline)
    assert louder.verdict == "changed"
    assert louder.level_db == pytest.approx(20.0 * np.log10(1.6), abs=0.3)
    assert judge(strikes("inner", seed=2), baseline=baseline).verdict == "inner"


CLIPPED = np.clip(strikes("inner", strength=4.0), -2.0, 2.0)
GAPPED = strikes("inner")
GAPPED[100:2000] = np.nan


@pytest.mark.parametrize(
    ("samples", "changes", "message"),
    [
        (np.zeros(60_000), {}, r"channel is dead: 100%"),
        (np.append(strikes(None, 1.0), np.zeros(48_000)), {}, r"channel is dead: 80%"),
        (np.repeat(strikes(None, 1.0), 5), {}, r"sampled at 2400 Hz and upsampled .each sample 5 times."),
        (CLIPPED, {}, r"channel is clipped: .* are at -2 or 2;"),
        (GAPPED, {}, r"lacks 3.2% of its samples"),
        (np.full(60_000, np.inf), {}, r"lacks 100.0% of its samples"),
        (strikes(None, 0.5), {}, r"too short: 0.5 s are 15 revolutions; give 25"),
        (np.zeros(0), {}, r"too short"),
        (strikes(None).reshape(-1, 2), {}, r"shape \[30000, 2\]; give one channel"),
        (strikes(None), {"rate_hz": 0.0}, r"sample rate is 0.0 Hz"),
        (strikes(None), {"rate_hz": 2000.0}, r"leaves the band 400 to 960 Hz"),
        (strikes(None), {"speed_rpm": 0.0}, r"shaft speed is 0.0 rpm; give the speed"),
        (strikes(None), {"speed_rpm": float("nan")}, r"shaft speed is nan rpm"),
        (
            strikes("inner", strength=1.5),
            {"speed_rpm": 1450.0},
            r"lines of the inner race .* at about 179\d rpm",
        ),
    ],
)
def test_bad_input_is_named_with_a_remedy(
    samples: np.ndarray, changes: dict[str, float], message: str
) -> None:
    with pytest.raises(UnfitError, match=message) as error:
        judge(samples, **changes)
    assert error.value.args[0].rpartition("; ")[2], "there is a remedy"


def test_single_missing_samples_and_an_offset_do_no_harm() -> None:
    samples = strikes("inner")
    samples[::1500] = np.nan
    v = judge(samples + 40.0)
    assert v.verdict == "inner"
    assert any("offset of 40" in note for note in v.notes)


def test_a_moving_mean_and_light_clipping_are_noted() -> None:
    samples = strikes(None)
    top = np.sort(np.abs(samples))[-60]
    notes = " ".join(judge(np.clip(samples, -top, top)).notes)
    assert "clipped" not in notes  # single peaks at a limit are no clipping
    samples[2000:2020] = samples.max()
    samples[30_000:] += 20.0
    v = judge(samples)
    assert v.verdict == "normal"
    assert any("mean moves" in note for note in v.notes)


class TestWatch:
    def test_it_judges_window_after_window_and_sees_more_with_time(self) -> None:
        samples = strikes("ball", 15.0, strength=0.5)
        watch = RaceWatch(RATE_HZ, SPEED_RPM, BEARING)
        verdicts = [watch.evaluate(w) for w in samples.reshape(-1, watch.window)]
        assert [round(v.revolutions) for v in verdicts[:5]] == [75, 150, 225, 299, 299]
        assert verdicts[3].verdict == "ball"
        assert verdicts[3].evidence["ball"].z > verdicts[0].evidence["ball"].z + 3.0

    def test_the_last_ten_seconds_are_those_of_the_test(self) -> None:
        samples = strikes("outer", 15.0)
        watch = RaceWatch(RATE_HZ, SPEED_RPM, BEARING)
        for window in samples.reshape(-1, watch.window):
            last = watch.evaluate(window)
        assert last == judge(samples[-120_000:])

    def test_a_window_is_judged_alone_after_forgetting(self) -> None:
        samples = strikes("inner", 5.0)
        watch = RaceWatch(RATE_HZ, SPEED_RPM, BEARING)
        watch.evaluate(samples[: watch.window])
        watch.forget()
        assert watch.evaluate(samples[watch.window :]) == judge(samples[watch.window :])

    def test_another_speed_begins_anew(self) -> None:
        watch = RaceWatch(RATE_HZ, SPEED_RPM, BEARING)
        watch.evaluate(strikes("outer", 2.5))
        v = watch.evaluate(strikes("outer", 2.5, speed_rpm=1500.0), speed_rpm=1500.0)
        assert v.verdict == "outer"
        assert v.revolutions == pytest.approx(62.5, rel=0.01)

    def test_bad_samples_are_forgotten(self) -> None:
        samples = strikes("outer", 5.0)
        watch = RaceWatch(RATE_HZ, SPEED_RPM, BEARING)
        watch.evaluate(samples[: watch.window])
        with pytest.raises(UnfitError, match="dead"):
            watch.evaluate(np.zeros(3 * watch.window))
        assert watch.evaluate(samples[watch.window :]).revolutions == pytest.approx(75.0, rel=0.01)
