"""The innovations model of a healthy machine: right, stable and white; what counts as a change of it."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from support.bearing_signals import INNER, OUTER, RATE_HZ, SPEED_RPM, Housing, healthy, knocks

from daqsvc.bearing.baseline import (
    BaselineFileError,
    learn_baseline,
    load_bearing_baseline,
    resampled,
    save_bearing_baseline,
)
from daqsvc.bearing.geometry import bearing_orders
from daqsvc.bearing.identify import (
    BANDS,
    LEAST_SAMPLES,
    ChangeRules,
    NotIdentifiableError,
    compare_residual,
    identify,
    learn_healthy,
    whiteness,
)

A1 = np.array([[1.2, 0.1], [-0.2, 0.9]])
A2 = np.array([[-0.7, 0.0], [0.1, -0.5]])
COVARIANCE = np.array([[1.0, 0.3], [0.3, 0.5]])


def vector_process(n: int = 60_000, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Two channels that drive each other, and the innovations behind them."""
    rng = np.random.default_rng(seed)
    e = rng.standard_normal((n, 2)) @ np.linalg.cholesky(COVARIANCE).T
    x = np.zeros((n, 2))
    for t in range(2, n):
        x[t] = A1 @ x[t - 1] + A2 @ x[t - 2] + e[t]
    return x, e


def test_two_sensors_are_identified_with_their_coupling() -> None:
    x, e = vector_process()
    model = identify(x, 1000.0)
    assert model.order == 2
    np.testing.assert_allclose(model.coefficients, [A1, A2], atol=0.02)
    np.testing.assert_allclose(model.covariance, COVARIANCE, atol=0.03)
    companion = np.block([[A1, A2], [np.eye(2), np.zeros((2, 2))]])
    assert model.spectral_radius == pytest.approx(np.abs(np.linalg.eigvals(companion)).max(), abs=0.01)
    assert model.whiteness.p_value > 0.01
    assert model.whiteness.predictable < 1e-3
    innovations = model.innovations(x)
    np.testing.assert_allclose(np.cov(innovations.T), np.eye(2), atol=0.01)
    behind = e[2:] @ np.linalg.inv(np.linalg.cholesky(COVARIANCE)).T
    assert np.abs(innovations - behind).max() < 0.1


def test_one_sensor_is_identified_whatever_its_unit() -> None:
    x = vector_process()[0][:, :1]
    model, scaled = identify(x, 1000.0), identify(9.80665 * x + 3.0, 1000.0)
    assert model.order == scaled.order
    np.testing.assert_allclose(model.coefficients, scaled.coefficients, atol=1e-6)
    np.testing.assert_allclose(scaled.covariance, 9.80665**2 * model.covariance, rtol=1e-6)


def test_channels_of_very_different_size_keep_their_conditioning() -> None:
    x, _ = vector_process()
    scale = np.array([1e-6, 1e3])
    model = identify(x * scale, 1000.0)
    np.testing.assert_allclose(
        model.coefficients, scale[:, None] * np.array([A1, A2]) / scale, rtol=0.3, atol=1e-8
    )
    np.testing.assert_allclose(np.cov(model.innovations(x * scale).T), np.eye(2), atol=0.01)


def test_a_model_of_too_low_an_order_is_not_white() -> None:
    x = healthy(20.0, 3)[:, np.newaxis]
    low, high = identify(x, RATE_HZ, most_order=2), identify(x, RATE_HZ)
    assert high.order > 10
    assert low.whiteness.predictable > 0.1 > 10.0 * high.whiteness.predictable
    assert low.whiteness.p_value < 1e-6


def test_whiteness_is_calibrated_on_noise() -> None:
    rng = np.random.default_rng(5)
    results = [whiteness(rng.standard_normal((4000, 2))) for _ in range(200)]
    rejected = sum(one.p_value < 0.05 for one in results)
    assert 2 <= rejected <= 22  # 10 are expected; P(outside) < 1e-3
    assert np.median([one.predictable for one in results]) < 5e-3


def test_missing_samples_spoil_no_more_than_what_needs_them() -> None:
    x, _ = vector_process(5000)
    model = identify(x, 1000.0)
    holed = x.copy()
    holed[1000:1003, 1] = np.nan
    found, whole = model.innovations(holed), model.innovations(x)
    lost = np.flatnonzero(np.isnan(found).any(axis=1))
    np.testing.assert_array_equal(lost, np.arange(1000, 1003 + model.order) - model.order)
    there = np.isfinite(found).all(axis=1)
    np.testing.assert_allclose(found[there], whole[there], atol=1e-9)


def test_what_cannot_be_learnt_from_is_refused() -> None:
    with pytest.raises(NotIdentifiableError, match=rf"100 samples are too few.*{LEAST_SAMPLES}"):
        identify(np.ones((100, 1)), 1000.0)
    with pytest.raises(NotIdentifiableError, match="channel 2 does not move"):
        identify(np.column_stack([healthy(1.0, 1), np.ones(12_000)]), RATE_HZ)
    with pytest.raises(NotIdentifiableError, match="too few to see how steady"):
        learn_healthy(healthy(0.5, 1)[:, np.newaxis], RATE_HZ)


def test_an_unsteady_machine_is_no_healthy_one() -> None:
    x = healthy(10.0, 2)
    louder = x * np.linspace(1.0, 1.6, len(x))
    with pytest.raises(NotIdentifiableError, match="from the first half of the recording to the second"):
        learn_healthy(louder[:, np.newaxis], RATE_HZ)
    knocked = x.copy()
    knocked[60_000:66_000] += 0.5 * np.random.default_rng(1).standard_normal(6000)
    with pytest.raises(NotIdentifiableError, match=r"at 5 s its innovations differ by \+"):
        learn_healthy(knocked[:, np.newaxis], RATE_HZ)
    holed = x.copy()
    holed[20_000:110_000] = np.nan
    with pytest.raises(NotIdentifiableError, match="complete enough"):
        learn_healthy(holed[:, np.newaxis], RATE_HZ)


@pytest.fixture(scope="module")
def reference():
    return learn_healthy(healthy(20.0, 7)[:, np.newaxis], RATE_HZ)


@pytest.mark.parametrize(("order", "size"), [(INNER, 0.6), (OUTER, 0.4)])
def test_damage_raises_the_innovations(reference, order, size) -> None:
    x = healthy(5.0, 8) + knocks(5.0, order, 9, size=size)
    change = compare_residual(reference, reference.levels_db(x[:, np.newaxis]))
    assert change.changed
    assert change.departure > 1.5
    assert change.ratio > 1.3
    assert int(np.argmax(change.rise_db[1:])) in {5, 6}  # where 3.1 kHz is
    assert not change.quiet
    assert not change.gain


def test_the_same_machine_at_another_unbalance_has_not_changed(reference) -> None:
    phase = 2.0 * np.pi * SPEED_RPM / 60.0 * np.arange(60_000) / RATE_HZ
    x = healthy(5.0, 11) + 0.5 * np.cos(phase)
    change = compare_residual(reference, reference.levels_db(x[:, np.newaxis]))
    assert not change.changed
    assert abs(change.rise_db[0]) < 0.5


def test_false_alarms_come_no_more_often_than_stated() -> None:
    """400 unchanged machines; sizes are set aside, so that significance alone decides."""
    rules = ChangeRules(false_alarm_probability=0.05, least_db=0.0, least_band_db=0.0, repeatability_db=0.0)
    rng = np.random.default_rng(3)
    taps = np.exp(-np.arange(16) / 4.0)
    alarms = 0
    for _ in range(20):
        x = np.convolve(rng.standard_normal(24_000), taps)[:24_000]
        learnt = learn_healthy(x[:, np.newaxis], 2000.0, most_order=16)
        for _ in range(20):
            y = np.convolve(rng.standard_normal(2 * learnt.window_samples), taps)[: learnt.window_samples]
            alarms += compare_residual(learnt, learnt.levels_db(y[:, np.newaxis]), rules).changed
    assert 4 <= alarms <= 38  # 20 are expected, in 20 machines that share a baseline by twenties


def test_a_machine_that_stands_still_and_a_wrong_unit_are_told_apart(reference) -> None:
    x = healthy(5.0, 12)[:, np.newaxis]
    quiet = compare_residual(reference, reference.levels_db(0.05 * x))
    assert quiet.quiet
    assert not quiet.changed
    other_unit = compare_residual(reference, reference.levels_db(9.80665 * x))
    assert other_unit.gain
    assert other_unit.ratio == pytest.approx(9.80665, rel=0.02)


def test_nothing_complete_is_nothing_to_compare(reference) -> None:
    with pytest.raises(ValueError, match=r"no window of 0\.5 s is complete"):
        compare_residual(reference, np.full((3, 1 + BANDS), np.nan))
    with pytest.raises(ValueError, match="no probability"):
        ChangeRules(false_alarm_probability=0.0)


@pytest.fixture(scope="module")
def baseline():
    a, b = healthy(10.0, 21), healthy(10.0, 22)
    orders = bearing_orders("6205-2RS")
    return learn_baseline(
        {"a": a, "b": a + b},
        RATE_HZ,
        SPEED_RPM,
        {"a": orders, "b": orders},
        [("a",), ("a", "b")],
        units={"a": "g", "b": "m/s2"},
        source='x"y\n',
    )


def test_a_baseline_comes_back_from_its_file_to_the_last_bit(baseline, tmp_path) -> None:
    save_bearing_baseline(baseline, tmp_path / "b.toml")
    again = load_bearing_baseline(tmp_path / "b.toml")
    assert (again.rate_hz, again.speed_rpm, again.source) == (RATE_HZ, SPEED_RPM, 'x"y\n')
    assert (again.races, again.units) == (baseline.races, {"a": "g", "b": "m/s2"})
    assert list(again.residuals) == [("a",), ("a", "b")]
    for names, before in baseline.residuals.items():
        after = again.residuals[names]
        assert (after.windows, after.window_samples) == (before.windows, before.window_samples)
        assert after.model.whiteness == before.model.whiteness
        for key in ("edges_hz", "mean_db", "spread_db", "rms"):
            np.testing.assert_array_equal(getattr(after, key), getattr(before, key))
        np.testing.assert_array_equal(after.model.coefficients, before.model.coefficients)
        np.testing.assert_array_equal(after.model.covariance, before.model.covariance)
    assert [path.name for path in tmp_path.iterdir()] == ["b.toml"]


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("rate_hz = 12000.0", 'rate_hz = "fast"', "rate_hz = 'fast'"),
        ("windows = 20", "windows = 1", r"residual.0.windows = 1: .*greater than or equal to 2"),
        ("covariance = [[", "covariance = [[-", "not positive definite"),
        ('channels = ["a"]', 'channels = ["a", "b"]', "not those of 2 channels"),
        ("evidence.inner", "evidence.inside", "evidence"),
        ('kind = "bearing"', 'kind = "rotor"', "kind = 'rotor'"),
        ("schema_version = 1", "schema_version = = 1", "restore the file, or calibrate again"),
        ("schema_version = 1", "schema_version = 1\nextra = 2", "extra = 2"),
    ],
)
def test_a_damaged_file_is_named_with_key_and_value(baseline, tmp_path, old, new, said) -> None:
    path = tmp_path / "b.toml"
    save_bearing_baseline(baseline, path)
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))
    with pytest.raises(BaselineFileError, match=said) as caught:
        load_bearing_baseline(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_file_that_is_not_there_or_cannot_be_written_is_named(baseline, tmp_path) -> None:
    with pytest.raises(BaselineFileError, match="No such file"):
        load_bearing_baseline(tmp_path / "none.toml")
    with pytest.raises(BaselineFileError, match="cannot be written"):
        save_bearing_baseline(baseline, tmp_path / "none" / "b.toml")


def test_a_faster_healthy_run_is_brought_to_the_rate_of_the_recordings() -> None:
    fast = Housing(seconds=10.0, rate_hz=48_000.0).samples
    slow, highest = resampled(fast, 48_000.0, 12_000.0)
    assert len(slow) == 120_000
    assert highest < 0.48
    again, same = resampled(slow, 12_000.0, 12_000.0)
    assert again is slow
    assert same == 0.48
    with pytest.raises(NotIdentifiableError, match="12000 Hz and cannot be compared at 48000 Hz"):
        resampled(slow, 12_000.0, 48_000.0)


def test_what_is_refused_names_the_channel() -> None:
    orders = bearing_orders("6205")
    with pytest.raises(NotIdentifiableError, match=r"^b: "):
        learn_baseline({"b": np.zeros(120_000)}, RATE_HZ, SPEED_RPM, {"b": orders}, [("b",)])
    short = learn_healthy(healthy(4.0, 1)[:, np.newaxis], RATE_HZ)
    assert short.windows == 16  # of a quarter of a second: the spread needs that many
    assert (
        dataclasses.replace(short, windows=4).limits_db(ChangeRules())[0] > short.limits_db(ChangeRules())[0]
    )
