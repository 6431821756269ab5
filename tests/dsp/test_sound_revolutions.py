"""A revolution in which nothing is wrong is seen to be sound at a glance, and only such a one is."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from daqsvc.dsp.probes import Probe
from daqsvc.dsp.quality import probes
from daqsvc.dsp.quality.clipped import clipped_at, never_clipped
from daqsvc.dsp.quality.probes import RevolutionJudge
from daqsvc.dsp.quality.sound import is_sound
from daqsvc.dsp.quality.stuck import dropped_to, never_rests, stands_still
from daqsvc.dsp.quality.unit import beyond_any_unit, within_some_unit
from daqsvc.dsp.speed.keyphasor import EdgeFinder, _median, _upper_quartile

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Floats = NDArray[np.float64]

PAIR = (Probe("probe-x", 0, 0.0), Probe("probe-y", 1, 90.0))
SHAPES = st.tuples(st.integers(1, 60), st.just(2))
COARSE = st.integers(-2, 2).map(float) | st.integers(-300, 300).map(float)
ODD = st.sampled_from([0.0, 1.0, np.nan, np.inf, -np.inf, 1e12, -1e12, 1.1e12, -3e300])


@given(arrays(np.float64, SHAPES, elements=COARSE))
def test_what_never_rests_or_is_never_clipped_does_so_in_no_probe(samples: Floats) -> None:
    for column in samples.T:
        if never_rests(samples):
            assert not stands_still(column[:, np.newaxis])
            assert dropped_to(column) is None
        if never_clipped(samples):
            assert clipped_at(column) is None


@given(arrays(np.float64, SHAPES, elements=ODD))
def test_what_is_within_some_unit_is_finite_and_beyond_none(samples: Floats) -> None:
    sound = bool(np.isfinite(samples).all()) and not any(beyond_any_unit(column) for column in samples.T)
    assert within_some_unit(samples) == sound


def runs(values: st.SearchStrategy[float]) -> st.SearchStrategy[list[float]]:
    """A signal that rests now and then, for as long as a habit is told from a standstill."""
    run = st.tuples(values, st.sampled_from([1, 1, 1, 1, 2, 3, 6, 7, 12, 40]))
    return st.lists(run, min_size=1, max_size=60).map(lambda parts: [v for v, n in parts for _ in range(n)])


@given(runs(COARSE | ODD), runs(COARSE), runs(COARSE | ODD), st.sampled_from([0.0, 0.5, 50.0]))
def test_what_is_sound_at_a_glance_is_so_when_it_is_looked_at(
    x: list[float], y: list[float], pulse: list[float], least_um: float
) -> None:
    n = min(len(x), len(y), len(pulse))
    samples = np.column_stack((x[:n], y[:n], pulse[:n]))
    if is_sound(samples, least_um):
        assert RevolutionJudge(PAIR, pooled=1).judge(samples[:, :2], least_um).quality == "good"
        assert not beyond_any_unit(samples[:, 2])
        assert np.isfinite(samples[:, 2]).all()


def test_a_revolution_of_a_turning_shaft_is_sound_and_one_with_a_fault_is_not() -> None:
    turn = 2.0 * np.pi * np.arange(320) / 320
    noise = np.random.default_rng(4).normal(0.0, 1.0, (320, 2))
    pulse = np.where(np.arange(320) < 32, -2.0, -10.0)
    # Of a converter that repeats values, as most do.
    whole = np.round(np.column_stack((40.0 * np.cos(turn), 40.0 * np.sin(turn), pulse)), 1)
    whole[:, :2] += np.round(noise, 1)
    assert is_sound(whole, 0.1)
    faults: dict[str, tuple[Any, int, float]] = {
        "dead": (slice(None), 1, 3.0),
        "stood still": (slice(100, 180), 0, 12.25),
        "missing": (7, 1, np.nan),
        "beyond any unit": (9, 2, 2e12),
    }
    for name, (rows, column, value) in faults.items():
        broken = whole.copy()
        broken[rows, column] = value
        assert not is_sound(broken, 0.1), name
    assert not is_sound(np.clip(whole, -20.0, 20.0), 0.1), "clipped"
    assert not is_sound(whole, 40.0), "hardly moves"
    assert not is_sound(whole * [1.0, 0.01, 1.0], 0.1), "one hardly moves beside the other"


@given(
    st.lists(
        st.lists(st.sampled_from([-3.0, -1.0, 0.0, 0.2, 1.0, 3.0, np.nan, np.inf, -np.inf]), max_size=6)
    ),
    st.sampled_from(["rising", "falling"]),
)
def test_edges_do_not_depend_on_how_the_samples_are_cut(blocks: list[list[float]], edge: Any) -> None:
    whole, parts = EdgeFinder(0.1, 0.5, edge), EdgeFinder(0.1, 0.5, edge)
    # With one that is missing the whole is not passed over at a glance, as parts of it are.
    signal = np.array([sample for block in blocks for sample in block])
    found, begin = [], 0
    for block in blocks:
        found += [(begin + at, back) for at, back in parts.find(np.array(block))]
        begin += len(block)
    assert found == whole.find(np.concatenate((signal, [np.nan])))


def test_nothing_is_looked_for_in_a_sound_revolution(monkeypatch: pytest.MonkeyPatch) -> None:
    def looked(*_arguments: Any) -> None:
        pytest.fail("it was looked for")

    for name in ("stands_still", "dropped_to", "clipped_at"):
        monkeypatch.setattr(probes, name, looked)
    monkeypatch.setattr(RevolutionJudge, "missing", looked)
    monkeypatch.setattr(RevolutionJudge, "_impossible", looked)
    turn = 2.0 * np.pi * np.arange(320) / 320
    noise = np.random.default_rng(4).normal(0.0, 1.0, (320, 2))
    samples = np.column_stack((40.0 * np.cos(turn), 40.0 * np.sin(turn))) + noise
    judge = RevolutionJudge(PAIR)
    assert [judge.judge(samples, 0.1).quality for _ in range(3)] == ["good"] * 3


@given(arrays(np.float64, st.tuples(st.integers(1, 4), st.integers(1, 9)), elements=st.floats(-1e9, 1e9)))
def test_the_median_of_the_keyphasor_is_numpys(values: Floats) -> None:
    np.testing.assert_array_equal(_median(values), np.median(values, axis=-1))


@given(arrays(np.float64, st.integers(1, 20), elements=st.floats(0.0, 1e9)))
def test_the_quartile_of_the_keyphasor_is_numpys(values: Floats) -> None:
    assert _upper_quartile(values) == np.quantile(values, 0.75)
