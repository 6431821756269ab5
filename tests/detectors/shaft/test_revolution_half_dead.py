"""A revolution in which a probe dies or fails for a moment is not good; one through a coarse converter is."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from daqsvc.dsp.probes import Probe
from daqsvc.dsp.quality.probes import RevolutionJudge

PROBES = (Probe("probe-x", 0, 0.0), Probe("probe-y", 1, 90.0))
TURN = 2 * np.pi * np.arange(64) / 64


def orbit() -> np.ndarray:
    noise = np.random.default_rng(4).normal(0, 1.0, (64, 2))
    return np.round(np.column_stack((40 * np.cos(TURN), 40 * np.sin(TURN))) + noise, 1)


@pytest.mark.parametrize("stands_at", [0.0, 17.5])
@pytest.mark.parametrize("part", [slice(0, 20), slice(24, 40), slice(44, 64)])
@pytest.mark.parametrize("column", [0, 1])
def test_a_revolution_with_a_dead_part_is_not_good(column, part, stands_at):
    samples = orbit()
    assert RevolutionJudge(PROBES).judge(samples, 0.1).quality == "good"
    samples[part, column] = stands_at
    verdict = RevolutionJudge(PROBES).judge(samples, 0.1)
    assert verdict.quality == "not_ok"
    still = part.stop - part.start
    assert f"{PROBES[column].name}: stuck at {stands_at:g} um for {still} of 64" in verdict.reason


@given(
    samples=st.integers(12, 700),
    steps=st.floats(2.0, 400.0),
    second=st.floats(-0.4, 0.4),
    phase=st.floats(0.0, 6.28),
    offset=st.floats(-0.5, 0.5),
)
@example(samples=601, steps=69.8, second=0.266, phase=0.0, offset=0.0)  # a crest as flat as it can be
def test_a_converter_of_any_coarseness_stands_still_nowhere(samples, steps, second, phase, offset):
    turn = 2 * np.pi * np.arange(samples) / samples + phase
    motion = np.cos(turn) + second * np.cos(2 * turn + offset)
    x, y = (np.round(steps * np.roll(motion, k) + offset) for k in (0, samples // 4))
    verdict = RevolutionJudge(PROBES).judge(np.column_stack((x, y)), 0.1)
    assert "stuck at" not in verdict.reason
