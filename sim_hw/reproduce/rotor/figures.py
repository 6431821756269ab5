"""Figures 4 to 7 of the paper."""

from __future__ import annotations

import itertools
import math
from typing import TYPE_CHECKING

import numpy as np

from daqsvc.rotor.decision import DecisionRules
from sim_hw.reproduce.rotor.experiment import MODES, SAMPLES_PER_REV, delays_rev, in_decibels, spoken
from sim_hw.reproduce.rotor.statements import convergence

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from numpy.typing import NDArray

    from daqsvc.rotor.decision import Rule
    from sim_hw.reproduce.rotor.experiment import RotorExperiment

    Floats = NDArray[np.float64]
    Pair = tuple[tuple[Floats, Floats], tuple[Floats, Floats]]

THRESHOLD = DecisionRules().probability_threshold
NAMES = {
    "N": "normal (N)",
    "F1": "Fault 1 (F1)",
    "F1L2": "Fault 1 Level 2 (F1 L2)",
    "F1L3": "Fault 1 Level 3 (F1 L3)",
}
# Okabe and Ito's colours, which the colour-blind tell apart.
PROCESS, OBSERVER, MEASURED = "#222222", "#0072B2", "#cccccc"
MODE_COLOURS = {"N": "#009E73", "F1": "#0072B2", "F1L2": "#CC79A7", "F1L3": "#D55E00"}
_TAU = r"normalised time $\tau = \omega_s t$"
_SHOWN_REV = {"N": 13.0, "F1L3": 40.0}
"""Orbits and sections are drawn from so many revolutions after the onset: the observer has converged."""
_CLOSE_UP_REV = (-3.0, 7.0)
"""Span of a close-up about a change of the process."""


def observer(figure: Figure, experiment: RotorExperiment, mode: str) -> None:
    """Figures 4 and 5: a mode's observer against the process.

    Args:
        figure: empty figure to draw on.
        experiment: the experiment.
        mode: N or F1L3.
    """
    figure.set_size_inches(10.0, 14.0)
    axes = figure.subplots(3, 2)
    figure.suptitle(
        f"Stochastic observer for the {NAMES[mode]} operating condition, {in_decibels(experiment.snr_db)}",
        fontsize=14,
    )
    part = experiment.samples_of(mode, settled_rev=_SHOWN_REV[mode])
    # From a whole revolution on: a section is taken at the keyphasor's mark.
    part = slice(-(-part.start // SAMPLES_PER_REV) * SAMPLES_PER_REV, part.stop)
    estimates = experiment.estimates[mode]
    orbits = ((experiment.x, experiment.y), (estimates.x, estimates.y))
    phases = ((experiment.x, experiment.vx), (estimates.x, estimates.vx))
    orbit, orbit_section, phase, phase_section, error_x, error_y = axes.flat
    orbit.plot(*experiment.measured[part].T, ".", color=MEASURED, markersize=2, label="measured")
    _curves(orbit, orbits, part)
    _points(orbit_section, orbits, part)
    _curves(phase, phases, part)
    _points(phase_section, phases, part)
    for axis in (orbit, orbit_section):
        _housing(axis)
        axis.set(xlim=(-1.4, 1.4), ylim=(-1.4, 1.4), xlabel="$x$ (clearances)", ylabel="$y$ (clearances)")
    limit = 1.2 * max(np.abs(experiment.x[part]).max(), np.abs(experiment.vx[part]).max())
    for axis in (phase, phase_section):
        axis.set(xlim=(-limit, limit), ylim=(-limit, limit), xlabel="$x$ (clearances)")
        axis.set_ylabel(r"$\dot x = \mathrm{d}x/\mathrm{d}\tau$ (clearances)")
    orbit.set_title("(a) orbit")
    orbit_section.set_title("(b) Poincaré map of the orbit")
    phase.set_title("(c) phase plot")
    phase_section.set_title("(d) Poincaré map of the phase plot")
    for axis in (orbit, orbit_section, phase, phase_section):
        axis.set_aspect("equal")
    for axis in (orbit, orbit_section, phase_section):
        axis.legend(loc="upper right", fontsize=8, framealpha=0.9)
    _errors((error_x, error_y), experiment, mode)
    for axis in axes.flat:
        axis.grid(visible=True, color="#eeeeee")
        axis.set_axisbelow(True)


def _curves(axes: Axes, pair: Pair, part: slice) -> None:
    (true_x, true_y), (expected_x, expected_y) = pair
    axes.plot(true_x[part], true_y[part], color=PROCESS, linewidth=1.2, label="process")
    axes.plot(expected_x[part], expected_y[part], color=OBSERVER, linewidth=0.7, alpha=0.8, label="observer")


def _points(axes: Axes, pair: Pair, part: slice) -> None:
    (true_x, true_y), (expected_x, expected_y) = pair
    section = slice(part.start, part.stop, SAMPLES_PER_REV)
    axes.plot(expected_x[section], expected_y[section], "x", color=OBSERVER, markersize=5, label="observer")
    axes.plot(
        true_x[section], true_y[section], "o", color=PROCESS, markersize=5, fillstyle="none", label="process"
    )


def _housing(axes: Axes) -> None:
    angle = np.linspace(0.0, 2.0 * math.pi, 361)
    axes.plot(np.cos(angle), np.sin(angle), "--", color="#888888", linewidth=1, label="housing")


def _errors(axes: tuple[Axes, Axes], experiment: RotorExperiment, mode: str) -> None:
    """Error of the observer in both directions, and behind it the innovations that it sees."""
    part = experiment.samples_of("N")
    if mode == "F1L3":
        onset = experiment.samples_of(mode).start
        part = slice(onset - 15 * SAMPLES_PER_REV, onset + 30 * SAMPLES_PER_REV)
    tau = experiment.tau[part]
    error = experiment.error(mode)[part]
    innovations = experiment.estimates[mode].innovations[part]
    limit = 1.35 * np.abs(innovations).max()
    for i, (axis, name, letter) in enumerate(zip(axes, "xy", "ef", strict=True)):
        axis.plot(tau, innovations[:, i], color=MEASURED, linewidth=0.6, label="innovation")
        axis.plot(tau, error[:, i], color=OBSERVER, linewidth=1.0, label="true error")
        axis.set(
            title=f"({letter}) observer error in ${name}$",
            xlabel=_TAU,
            ylabel=rf"${name} - \hat {name}$ (clearances)",
            xlim=(tau[0], tau[-1]),
            ylim=(-limit, limit),
        )
        if mode == "F1L3":
            _mark(axis, 2.0 * math.pi * experiment.begins_rev[-1], MODE_COLOURS[mode], "F1 L3 begins")
            begins = convergence(experiment).begins
            if math.isfinite(begins):
                _mark(axis, begins, PROCESS, rf"converges from $\tau$ = {begins:.0f}")
        axis.legend(loc="upper right", ncols=2, fontsize=8, framealpha=0.9)


def _mark(axes: Axes, tau: float, colour: str, label: str) -> None:
    axes.axvline(tau, color=colour, linewidth=1.2, linestyle="--", label=label)


def probabilities(figure: Figure, experiment: RotorExperiment, modes: tuple[str, str]) -> None:
    """Figures 6 and 7: probabilities of two modes, over the whole run and about the change.

    Args:
        figure: empty figure to draw on.
        experiment: the experiment.
        modes: the two modes.
    """
    figure.set_size_inches(12.0, 7.5)
    axes = figure.subplots(2, 2, width_ratios=(1.5, 1.0))
    figure.suptitle(
        f"Probability for {NAMES[modes[0]]} and {NAMES[modes[1]]}, {in_decibels(experiment.snr_db)}",
        fontsize=14,
    )
    for row, mode in enumerate(modes):
        i = MODES.index(mode)
        whole, close = axes[row]
        whole.set(xlim=(0.0, experiment.tau[-1]), title=f"({'ac'[row]}) P({spoken(mode)}) over the whole run")
        change = max(i, 1)
        onset_rev = experiment.begins_rev[change]
        close.set_xlim(*(2.0 * math.pi * (onset_rev + rev) for rev in _CLOSE_UP_REV))
        close.set_title(
            f"({'bd'[row]}) close-up: {spoken(MODES[change - 1])} becomes {spoken(MODES[change])}"
        )
        tau, probability = _saw_teeth(experiment, i)
        for axis in (whole, close):
            _periods(axis, experiment)
            axis.plot(tau, probability, color=MODE_COLOURS[mode], linewidth=0.7 if axis is whole else 1.2)
            axis.axhline(THRESHOLD, color="#888888", linewidth=0.8, linestyle="--")
            axis.set(ylim=(-0.02, 1.3), yticks=np.linspace(0.0, 1.0, 6), xlabel=_TAU)
            axis.set_ylabel(f"P({spoken(mode)})")
        _declarations(close, experiment, change)


def _saw_teeth(experiment: RotorExperiment, mode: int) -> tuple[Floats, Floats]:
    """Normalised time and probability of a mode, with a tooth's tip at the threshold where it is declared.

    The bank states a probability after its reset; just before it, that of the declared mode had
    passed the threshold.
    """
    tips = np.flatnonzero(experiment.trace.declared == mode)
    tau = np.insert(experiment.tau, tips, experiment.tau[tips])
    return tau, np.insert(experiment.trace.probabilities[:, mode], tips, THRESHOLD)


def _periods(axes: Axes, experiment: RotorExperiment) -> None:
    """Colours for the mode that the process is in."""
    marks = [2.0 * math.pi * rev for rev in (*experiment.begins_rev, experiment.end_rev)]
    for mode, (begin, end) in zip(MODES, itertools.pairwise(marks), strict=True):
        axes.axvspan(begin, end, color=MODE_COLOURS[mode], alpha=0.08, linewidth=0)
        axes.axvline(begin, color=MODE_COLOURS[mode], linewidth=0.8)
        first, last = axes.get_xlim()
        shown = (max(begin, first), min(end, last))
        if shown[1] > shown[0]:
            axes.text(sum(shown) / 2, 0.94, spoken(mode), color=MODE_COLOURS[mode], ha="center", va="bottom")


def _declarations(axes: Axes, experiment: RotorExperiment, change: int) -> None:
    """Where either rule first declares the mode that has begun, and how many revolutions that took."""
    styles: dict[Rule, tuple[str, str]] = {"paper": ("^", "the paper's rule"), "cusum": ("v", "CUSUM")}
    for rule, (marker, name) in styles.items():
        delays = delays_rev(experiment.shown[rule].changes, experiment.begins_rev, experiment.end_rev)
        if math.isfinite(delays[change]):
            at = 2.0 * math.pi * (experiment.begins_rev[change] + delays[change])
            label = f"{spoken(MODES[change])} declared by {name}: {delays[change]:.2f} rev"
            axes.plot(at, 0.97, marker, color=PROCESS, markersize=7, label=label)
        else:
            axes.plot([], [], " ", label=f"{spoken(MODES[change])} not declared by {name}")
    axes.legend(loc="upper right", fontsize=8, framealpha=0.9)
