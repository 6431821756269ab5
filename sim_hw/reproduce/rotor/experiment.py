"""The experiment: the paper's schedule on the simulated plant, through observers and bank."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from sim_hw.plants.rotor import Change, simulate
from sim_hw.plants.sensors import noise_sigma
from sim_hw.reproduce.rotor import detection, motion, observers
from sim_hw.reproduce.rotor.setup import (
    MODE_DURATION,
    MODES,
    OBSERVER_ALPHA,
    OBSERVER_MU,
    RUB_REVOLUTIONS,
    SAMPLE,
    SAMPLES_PER_REV,
    SNR_DB,
    hypotheses,
    plant,
)

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from daqsvc.rotor.decision import Rule
    from sim_hw.reproduce.rotor.detection import DetectionRun, DetectionTrace
    from sim_hw.reproduce.rotor.observers import Estimates

    Floats = NDArray[np.float64]
    Flags = NDArray[np.bool_]

NOISE_DRAWS = 100
"""Draws of the sensor noise at each signal-to-noise ratio, for delays and wrong declarations."""
_FINER = 8
"""The plant is sampled this much finer, to differentiate its position."""


@dataclass(frozen=True)
class RotorExperiment:
    """What the plant did, and what observers and bank made of it.

    Attributes:
        snr_db: signal-to-noise ratio of the run that is shown.
        noise: standard deviation of its sensor noise in clearances.
        begins_rev: revolution at which each mode begins.
        end_rev: length of the run in revolutions.
        tau: float64 ``[n]``, normalised time.
        x: float64 ``[n]``, true horizontal position in clearances.
        vx: float64 ``[n]``, its velocity in clearances per normalised time.
        y: float64 ``[n]``, true vertical position in clearances.
        measured: float64 ``[n, 2]``, position with sensor noise.
        estimates: of the free-running observers under the paper's rule, by mode.
        trace: the paper's rule on the run that is shown.
        shown: runs of the bank on the same measurement, by rule.
        statistics: runs on other draws of the noise, by rule and signal-to-noise ratio in dB.
        settled: the rub after its transient.
        escape: how the rotor leaves its housing with the printed signs.
        whirl_of_observer: turns per revolution of the rub observer's rotor without measurements.
    """

    snr_db: float
    noise: float
    begins_rev: tuple[float, ...]
    end_rev: float
    tau: Floats
    x: Floats
    vx: Floats
    y: Floats
    measured: Floats
    estimates: Mapping[str, Estimates]
    trace: DetectionTrace
    shown: Mapping[Rule, DetectionRun]
    statistics: Mapping[tuple[Rule, float], tuple[DetectionRun, ...]]
    settled: motion.SettledRub
    escape: motion.Escape
    whirl_of_observer: float

    @cached_property
    def radius(self) -> Floats:
        """Distance of the disc from the housing's centre, float64 ``[n]``, in clearances."""
        return np.hypot(self.x, self.y)

    def samples_of(self, mode: str, *, settled_rev: float = 0.0) -> slice:
        """The samples of a mode, or those from so many revolutions after its onset."""
        i = MODES.index(mode)
        ends = (*self.begins_rev[1:], self.end_rev)
        first = math.ceil((self.begins_rev[i] + settled_rev) * SAMPLES_PER_REV)
        return slice(first, math.ceil(ends[i] * SAMPLES_PER_REV))

    def error(self, mode: str) -> Floats:
        """Error of a mode's observer, true less expected x and y, float64 ``[n, 2]``, in clearances."""
        estimates = self.estimates[mode]
        return np.column_stack((self.x - estimates.x, self.y - estimates.y))


def run(seed: int, snr_db: float) -> RotorExperiment:
    """Do the experiment.

    Args:
        seed: of the sensor noise.
        snr_db: AC power of a probe in mode N over the noise's variance, for the run that is shown.
    """
    rev_per_mode = MODE_DURATION / (2.0 * math.pi)
    begins = tuple(i * rev_per_mode for i in range(len(MODES)))
    end = begins[-1] + RUB_REVOLUTIONS
    changes = [Change(begin, plant(mode)) for begin, mode in zip(begins[1:], MODES[1:], strict=True)]
    fine = simulate(plant("N"), changes, revolutions=end, samples_per_rev=_FINER * SAMPLES_PER_REV)
    x, y = fine.x[::_FINER], fine.y[::_FINER]
    vx = np.gradient(fine.x, SAMPLE / _FINER)[::_FINER]
    true = np.column_stack((x, y))
    tau = np.arange(len(x), dtype=np.float64) * SAMPLE

    shown_draw, statistics_draws = np.random.SeedSequence(seed).spawn(2)
    amplitude = abs(plant("N").orbit_1x)
    noise = noise_sigma(amplitude, snr_db)
    measured = true + noise * np.random.default_rng(shown_draw).normal(size=true.shape)

    onset_of_rub = plant("F1L2").steady_state()
    return RotorExperiment(
        snr_db=snr_db,
        noise=noise,
        begins_rev=begins,
        end_rev=end,
        tau=tau,
        x=x,
        vx=vx,
        y=y,
        measured=measured,
        estimates=observers.observe(hypotheses("paper"), measured, tau, noise=noise, duration=SAMPLE),
        trace=detection.trace(measured, tau, noise),
        shown={
            rule: detection.run(detection.new_bank(rule, noise), measured, tau) for rule in detection.RULES
        },
        statistics=_statistics(true, tau, amplitude, statistics_draws),
        settled=motion.settled_rub(plant("F1L3"), onset_of_rub, SAMPLES_PER_REV),
        escape=motion.escape_with_printed_signs(plant("F1L3"), onset_of_rub),
        whirl_of_observer=motion.whirl_of_model(
            replace(plant("F1L3"), contact_exponent=OBSERVER_ALPHA, friction=OBSERVER_MU),
            onset_of_rub,
            SAMPLES_PER_REV,
        ),
    )


def _statistics(
    true: Floats, tau: Floats, amplitude: float, draws: np.random.SeedSequence
) -> dict[tuple[Rule, float], tuple[DetectionRun, ...]]:
    """The bank on many draws of the noise: the same draws at every ratio and under both rules."""
    normal = [np.random.default_rng(draw).normal(size=true.shape) for draw in draws.spawn(NOISE_DRAWS)]
    runs: dict[tuple[Rule, float], tuple[DetectionRun, ...]] = {}
    for snr_db in SNR_DB:
        noise = noise_sigma(amplitude, snr_db)
        for rule in detection.RULES:
            bank = detection.new_bank(rule, noise)
            runs[rule, snr_db] = tuple(detection.run(bank, true + noise * draw, tau) for draw in normal)
    return runs
