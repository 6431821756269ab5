"""The paper's schedule (section V) on the simulated plant, through observers and bank.

The paper's numbers come first, and those that it leaves open; then one observer's estimates, sample by
sample, which the bank keeps to itself. Then what the bank declares under either rule, how soon and how
rightly.
"""

from __future__ import annotations

import copy
import itertools
import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from daqsvc.rotor import kernels
from daqsvc.rotor.bank import ModelBank
from daqsvc.rotor.decision import DecisionRules, Rule
from daqsvc.rotor.discretise import BankMode, discretise
from daqsvc.rotor.model import NormalisedRotor
from sim_hw.plants.rotor import Change, PlantParameters, noise_sigma, simulate
from sim_hw.reproduce.rotor import motion

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    Floats = NDArray[np.float64]
    Ints = NDArray[np.int64]
    Flags = NDArray[np.bool_]


MODES = ("N", "F1", "F1L2", "F1L3")
DAMPING = {"N": 0.18, "F1": 0.10, "F1L2": 0.06, "F1L3": 0.02}
MODE_DURATION = 170.0
"""Normalised time that N, F1 and F1 L2 last each."""
PAPER_REVOLUTIONS = 26
"""What the paper takes that to be in revolutions."""
RUB_REVOLUTIONS = 80
"""Revolutions that F1 L3 lasts."""
SNR_DB = (-5.0, 0.0, 5.0)
"""The paper's range of signal-to-noise ratios, and its middle."""
CONVERGENCE = 520.0
"""Normalised time at which the paper sees the error of the F1 L3 observer begin to converge."""
OBSERVER_ALPHA, OBSERVER_MU = 1.0, 0.1
"""Exponent and friction of the F1 L3 observer; the process has 1.5 and 0.3."""

# From here on the paper is silent.
SAMPLES_PER_REV = 64
SAMPLE = 2.0 * math.pi / SAMPLES_PER_REV
"""Normalised time between samples at w = 1."""
PROCESS_NOISE = 1e-4
"""Power spectral density of the acceleration noise that the linear observers are designed for."""
RUB_PROCESS_NOISE: dict[Rule, float] = {"paper": 3e-4, "cusum": 0.1}
"""That of the rub observer.

Under the paper's rule, and in figure 5, it trusts its model, so that its error shows when the model holds.
Under this service's own rule it follows nearly everything, which makes it a weak rival of the others in
transients.
"""


def plant(mode: str) -> PlantParameters:
    """The process in a mode: w = 1, e = 0.1, k = 1, g = 0.1, K* = 30, alpha = 1.5, mu = 0.3."""
    return replace(PlantParameters(), damping_ratio=DAMPING[mode])


def hypotheses(rule: Rule) -> tuple[BankMode, ...]:
    """The observers' models for a decision rule, with the mismatch of the rub observer.

    Args:
        rule: the rule.
    """
    return tuple(
        BankMode(
            mode,
            _model(mode),
            RUB_PROCESS_NOISE[rule] if mode == "F1L3" else PROCESS_NOISE,
            rub=mode == "F1L3",
        )
        for mode in MODES
    )


def _model(mode: str) -> NormalisedRotor:
    process = plant(mode)
    return NormalisedRotor(
        w=process.speed_ratio,
        e=process.eccentricity,
        zeta=process.damping_ratio,
        k=process.stiffness,
        g=process.gravity,
        contact_stiffness=process.contact_stiffness,
        alpha=OBSERVER_ALPHA,
        mu=OBSERVER_MU,
        contact_radius=process.disc_radius,
    )


def spoken(mode: str) -> str:
    """A mode as the paper writes it, ``F1 L2`` for ``F1L2``."""
    return mode.replace("L", " L")


def in_decibels(snr_db: float) -> str:
    """A signal-to-noise ratio with sign and unit."""
    return f"{snr_db:+g} dB" if snr_db else "0 dB"


@dataclass(frozen=True, slots=True)
class Estimates:
    """What an observer expected at every sample, before it saw it.

    Attributes:
        x: float64 ``[n]``, horizontal position in clearances.
        vx: float64 ``[n]``, horizontal velocity in clearances per normalised time.
        y: float64 ``[n]``, vertical position in clearances.
        innovations: float64 ``[n, 2]``, measured less expected position in clearances.
    """

    x: Floats
    vx: Floats
    y: Floats
    innovations: Floats


def observe(
    modes: Sequence[BankMode], xy: Floats, angle_rad: Floats, *, noise: float, duration: float
) -> dict[str, Estimates]:
    """Let free-running observers follow a measurement, from a disc that rests in the centre.

    Args:
        modes: the observers' models, the healthy one first.
        xy: float64 ``[n, 2]``, measured position in clearances.
        angle_rad: float64 ``[n]``, shaft angle.
        noise: standard deviation of the measured position in clearances.
        duration: normalised time between samples.

    Returns:
        Estimates by the name of the mode.
    """
    observers = discretise(modes, noise=noise, duration=duration)
    cos, sin = np.cos(angle_rad), np.sin(angle_rad)
    orbits = _orbits(observers, cos, sin)
    # A state is the deviation from the mode's own orbit.
    states = -orbits[0]
    deviations = np.empty_like(orbits)
    usable = np.ones(1, dtype=np.bool_)
    scores = np.empty((len(modes), 1))
    for k in range(len(xy)):
        deviations[k] = states
        now = slice(k, k + 1)
        kernels.run_free(xy[now], usable, cos[now], sin[now], observers, states, scores)
    expected = orbits + deviations
    return {
        mode.name: Estimates(
            x=expected[:, i, 0],
            vx=expected[:, i, 1],
            y=expected[:, i, 2],
            innovations=xy - expected[:, i, [0, 2]],
        )
        for i, mode in enumerate(modes)
    }


def _orbits(observers: NDArray[np.void], cos: Floats, sin: Floats) -> Floats:
    """Reference orbits as states, float64 ``[n, M, 4]``."""
    turning = (observers["a"] + 1j * observers["b"]) * (cos + 1j * sin)[:, np.newaxis]
    velocity = 1j * observers["speed"] * turning
    position = turning + observers["rest_x"] + 1j * observers["rest_y"]
    return np.stack((position.real, velocity.real, position.imag, velocity.imag), axis=-1)


RULES: tuple[Rule, ...] = ("paper", "cusum")
_EXCUSED_REV = 3.0
"""For this long after a change the mode before it is not wrong yet."""


@dataclass(frozen=True, slots=True)
class DetectionTrace:
    """The paper's rule, sample by sample.

    Attributes:
        probabilities: float64 ``[n, M]``, conditional probabilities; at a declaration those after the reset.
        declared: int64 ``[n]``, index of the mode declared at the sample, -1 where there was none.
    """

    probabilities: Floats
    declared: Ints


@dataclass(frozen=True, slots=True)
class DetectionRun:
    """One run of the bank over the whole schedule.

    Attributes:
        changes: declared modes in order, as (sample, index of the mode).
        paper_declarations: how often the paper's rule declared a mode, changed or not.
    """

    changes: tuple[tuple[int, int], ...]
    paper_declarations: int


def new_bank(rule: Rule, noise: float) -> ModelBank:
    """The bank of the four modes.

    Args:
        rule: the rule whose mode counts as declared.
        noise: standard deviation of the measured position in clearances.
    """
    return ModelBank(hypotheses(rule), noise=noise, duration=SAMPLE, rules=DecisionRules(rule=rule))


def trace_paper_rule(xy: Floats, angle_rad: Floats, noise: float) -> DetectionTrace:
    """Follow the paper's rule through a measurement, sample by sample.

    Args:
        xy: float64 ``[n, 2]``, measured position in clearances.
        angle_rad: float64 ``[n]``, shaft angle.
        noise: standard deviation of the measured position.
    """
    bank = new_bank("paper", noise)
    cos, sin = np.cos(angle_rad), np.sin(angle_rad)
    probabilities = np.empty((len(xy), len(MODES)))
    declared = np.full(len(xy), -1, dtype=np.int64)
    for k in range(len(xy)):
        now = slice(k, k + 1)
        report = bank.process(xy[now], cos[now], sin[now])
        probabilities[k] = report.probabilities
        if report.paper_declarations:
            declared[k] = report.decision
    return DetectionTrace(probabilities, declared)


def run_bank(bank: ModelBank, xy: Floats, angle_rad: Floats) -> DetectionRun:
    """A bank over a whole measurement at once.

    Args:
        bank: as `new_bank` made it; it stays new.
        xy: float64 ``[n, 2]``, measured position in clearances.
        angle_rad: float64 ``[n]``, shaft angle.
    """
    report = copy.deepcopy(bank).process(xy, np.cos(angle_rad), np.sin(angle_rad))
    changes = tuple((change.sample, change.mode) for change in report.declarations)
    return DetectionRun(changes, report.paper_declarations)


def delays_rev(changes: Sequence[tuple[int, int]], begins_rev: Sequence[float], end_rev: float) -> Floats:
    """Revolutions from each onset to the first declaration of that mode, before the next onset.

    A mode that was declared already, wrongly, when it began has a delay of 0; one that was not
    declared before the next began has an infinite one.

    Args:
        changes: as in `DetectionRun`.
        begins_rev: revolution at which each of the modes begins, the healthy one first.
        end_rev: end of the run.

    Returns:
        float64 ``[M]``.
    """
    delays = np.full(len(begins_rev), np.inf)
    for mode, (begin, end) in enumerate(itertools.pairwise([*begins_rev, end_rev])):
        at = [(sample / SAMPLES_PER_REV, declared) for sample, declared in changes]
        before = [declared for rev, declared in at if rev < begin]
        if before and before[-1] == mode:
            delays[mode] = 0.0
        else:
            after_rev = (rev - begin for rev, declared in at if declared == mode and begin <= rev < end)
            delays[mode] = min(after_rev, default=np.inf)
    return delays


def wrong_changes(changes: Sequence[tuple[int, int]], begins_rev: Sequence[float]) -> int:
    """Changes of the declared mode to one that the machine is not in.

    The mode before a change is excused for three revolutions; a mode that is passed on the way counts.

    Args:
        changes: as in `DetectionRun`.
        begins_rev: revolution at which each of the modes begins, the healthy one first.
    """
    wrong = 0
    for sample, declared in changes:
        rev = sample / SAMPLES_PER_REV
        true = int(np.searchsorted(begins_rev, rev, side="right")) - 1
        excused = declared == true - 1 and rev - begins_rev[true] < _EXCUSED_REV
        wrong += declared != true and not excused
    return wrong


NOISE_DRAWS = 100
"""Draws of the sensor noise at each signal-to-noise ratio, for delays and wrong declarations."""
_FINER = 8
"""The plant is sampled this much finer, to differentiate its position."""


@dataclass(frozen=True)
class RotorExperiment:
    """What the plant did, and the estimates of observers and bank.

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
        escape_rev: revolutions from contact until the rotor is out of its housing, with the printed signs.
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
    escape_rev: float
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
        estimates=observe(hypotheses("paper"), measured, tau, noise=noise, duration=SAMPLE),
        trace=trace_paper_rule(measured, tau, noise),
        shown={rule: run_bank(new_bank(rule, noise), measured, tau) for rule in RULES},
        statistics=_statistics(true, tau, amplitude, statistics_draws),
        settled=motion.settled_rub(plant("F1L3"), onset_of_rub, SAMPLES_PER_REV),
        escape_rev=motion.escape_with_printed_signs(plant("F1L3"), onset_of_rub),
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
        for rule in RULES:
            bank = new_bank(rule, noise)
            runs[rule, snr_db] = tuple(run_bank(bank, true + noise * draw, tau) for draw in normal)
    return runs
