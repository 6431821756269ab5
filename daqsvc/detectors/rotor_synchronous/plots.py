"""Figures of a verdict: what the shaft did, and what the detector found.

Needs matplotlib (``pip install 'daqsvc[plot]'``); imported only by who draws.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.projections.polar import PolarAxes

from daqsvc.detectors.shaft.verdict import VERDICTS
from daqsvc.diagnosis.recorded import shortened
from daqsvc.dsp.quality.unit import to_um
from daqsvc.rotor.synchronous.baseline import compensated

if TYPE_CHECKING:
    from collections.abc import Callable

    from matplotlib.axes import Axes
    from numpy.typing import NDArray

    from daqsvc.detectors.rotor_synchronous.recorded_speed import RotorSetup
    from daqsvc.detectors.shaft.verdict import RotorVerdict, Trace
    from daqsvc.recording.recording import Recording
    from daqsvc.rotor.synchronous.baseline import Calibration

    Complexes = NDArray[np.complex128]
    Floats = NDArray[np.float64]

_HEALTHY = "#0072b2"
_NOW = "#d55e00"
_QUIET = "#8c8c8c"
# Okabe and Ito's colours: told apart by everybody, and in grey.
_COLOURS = dict(
    zip(
        VERDICTS,
        ("#0072b2", "#e69f00", "#009e73", "#cc79a7", "#56b4e9", "#d55e00", "#000000", "#8c8c8c"),
        strict=True,
    )
)
_LEAST_NATS = 0.03
"""Where the logarithmic axis ends."""
_SHOWN_REVOLUTIONS = 20
_POINTS = 128
_HARMONICS = 8
"""Harmonics of a mean revolution that are drawn."""
_DPI = 110
_COMPONENTS = ("mean", "1X", "-1X", "2X", "-2X")


@dataclass(frozen=True, slots=True)
class _Subject:
    """What every figure is drawn from.

    Attributes:
        name: of the recording.
        probes: names of the probes.
        analysis: the verdict.
        trace: what it was made of.
        calibration: the healthy machine.
        xy: float64 ``[n, 2]``, the probes in um.
        rate_hz: sampling rate.
        clearance_um: radial clearance, if known.
    """

    name: str
    probes: tuple[str, str]
    analysis: RotorVerdict
    trace: Trace
    calibration: Calibration
    xy: Floats
    rate_hz: float
    clearance_um: float | None

    @property
    def revolutions(self) -> NDArray[np.int64]:
        """Numbers of the revolutions that were judged, from 1."""
        return np.array([report.revolution for report in self.trace.reports])

    @property
    def healthy(self) -> slice:
        """The last revolutions before the onset, or of those that calibrated."""
        onset = self.analysis.onset
        until = self.calibration.revolutions if onset is None else onset.revolution
        end = max(1, int(np.searchsorted(self.revolutions, until, side="right")))
        return slice(max(0, end - _SHOWN_REVOLUTIONS), end)

    @property
    def last(self) -> slice:
        """The last revolutions of the recording."""
        return slice(max(0, len(self.trace.vectors) - _SHOWN_REVOLUTIONS), len(self.trace.vectors))

    def orbits(self, part: slice) -> Floats:
        """Revolutions at `_POINTS` even angles and back at the first, float64 ``[r, _POINTS + 1, 2]``."""
        vectors = self.trace.vectors[part]
        place = vectors.end_index - vectors.period_samples
        at = place[:, np.newaxis] + np.outer(vectors.period_samples, np.arange(_POINTS + 1) / _POINTS)
        samples = np.arange(len(self.xy))
        return np.stack([np.interp(at, samples, self.xy[:, k]) for k in (0, 1)], axis=-1)


def draw(recording: Recording, setup: RotorSetup, analysis: RotorVerdict, prefix: str) -> list[str]:
    """Write the figures of a verdict as PNG files.

    Args:
        recording: the recording.
        setup: what was known.
        analysis: the verdict; one that was not refused.
        prefix: what the files' names begin with, directory included.

    Returns:
        The files.
    """
    assert analysis.trace is not None  # noqa: S101 - not refused
    assert analysis.calibration is not None  # noqa: S101 - not refused
    columns = [recording.names.index(probe) for probe in setup.probes]
    subject = _Subject(
        name=recording.source.name,
        probes=setup.probes,
        analysis=analysis,
        trace=analysis.trace,
        calibration=analysis.calibration,
        xy=to_um(recording.samples[:, columns].astype(np.float64), setup.unit),
        rate_hz=recording.rate_hz,
        clearance_um=setup.rotor.clearance_um,
    )
    figures: dict[str, Callable[[_Subject], Figure]] = {
        "orbit": _orbit,
        "poincare": _poincare,
        "phase-plane": _phase_plane,
        "probabilities": _probabilities,
        "innovations": _innovations,
        "polar": _polar,
    }
    files = []
    for name, make in figures.items():
        files.append(f"{prefix}-{name}.png")
        make(subject).savefig(files[-1], dpi=_DPI)
    return files


def _figure(subject: _Subject, title: str, size: tuple[float, float]) -> Figure:
    figure = Figure(figsize=size, layout="constrained")
    finding = " or ".join(name.replace("_", " ") for name in subject.analysis.group) or "not judged"
    figure.suptitle(f"{title}: {shortened(subject.name)}\n{finding}", fontsize=11)
    return figure


def _pair(subject: _Subject) -> list[tuple[slice, str, str]]:
    """What is drawn against each other: revolutions, colour, label."""
    count = subject.healthy.stop - subject.healthy.start
    if subject.analysis.onset is None:
        return [(subject.last, _HEALTHY, f"last {subject.last.stop - subject.last.start} revolutions")]
    return [
        (subject.healthy, _HEALTHY, f"healthy, {count} revolutions before the change"),
        (subject.last, _NOW, f"last {subject.last.stop - subject.last.start} revolutions"),
    ]


def _orbit(subject: _Subject) -> Figure:
    figure = _figure(subject, "Orbit", (6.4, 6.8))
    axes = figure.add_subplot()
    for part, colour, label in _pair(subject):
        orbits = subject.orbits(part)
        for orbit in orbits:
            axes.plot(orbit[:, 0], orbit[:, 1], color=colour, alpha=0.15, linewidth=0.6)
        mean = _smooth(orbits.mean(axis=0))
        axes.plot(mean[:, 0], mean[:, 1], color=colour, linewidth=2.0, label=label)
        axes.plot(*mean[0], "o", color=colour, markersize=7, markeredgecolor="white")
    _clearance(axes, subject)
    axes.plot([], [], "o", color=_QUIET, label="shaft angle zero")
    _plane(figure, axes, f"{subject.probes[0]} in um", f"{subject.probes[1]} in um")
    return figure


def _clearance(axes: Axes, subject: _Subject) -> None:
    """The circle of the clearance, if the orbit comes anywhere near it."""
    clearance = subject.clearance_um
    if clearance is None:
        return
    radius = float(np.nanmax(np.hypot(*subject.xy.T)))
    if clearance < 4.0 * radius:
        turn = np.linspace(0.0, 2.0 * math.pi, 241)
        axes.plot(
            clearance * np.cos(turn),
            clearance * np.sin(turn),
            "--",
            color="black",
            linewidth=1.0,
            label=f"clearance {clearance:.4g} um",
        )


def _plane(figure: Figure, axes: Axes, across: str, up: str) -> None:
    axes.set_aspect("equal", adjustable="datalim")
    axes.set_xlabel(across)
    axes.set_ylabel(up)
    axes.grid(alpha=0.3)
    _legend_below(figure, axes, columns=2)


def _poincare(subject: _Subject) -> Figure:
    figure = _figure(subject, "Poincare map at shaft angle zero", (6.8, 6.2))
    axes = figure.add_subplot()
    points = subject.orbits(slice(None))[:, 0]
    drawn = axes.scatter(
        points[:, 0], points[:, 1], c=subject.revolutions, cmap="viridis", s=14, linewidths=0, zorder=2
    )
    figure.colorbar(drawn, ax=axes, label="revolution", shrink=0.85)
    for part, colour, label in _pair(subject):
        axes.plot(
            *points[part].mean(axis=0), "+", color=colour, markersize=16, mew=2.5, label=f"mean, {label}"
        )
    _plane(figure, axes, f"{subject.probes[0]} in um", f"{subject.probes[1]} in um")
    return figure


def _phase_plane(subject: _Subject) -> Figure:
    figure = _figure(subject, "Phase plane, mean of the revolutions", (9.6, 5.2))
    for k, axes in enumerate(figure.subplots(1, 2)):
        for part, colour, label in _pair(subject):
            place, velocity = _motion(subject, part, k)
            axes.plot(place, velocity, color=colour, linewidth=1.8, label=label)
        axes.set_xlabel(f"{subject.probes[k]} in um")
        axes.set_ylabel("velocity in mm/s")
        axes.grid(alpha=0.3)
    _legend_below(figure, axes, columns=2)
    return figure


def _smooth(mean: Floats) -> Floats:
    """A mean revolution up to its eighth harmonic, closed, float64 ``[_POINTS + 1, 2]``."""
    spectrum = np.fft.rfft(mean[:_POINTS], axis=0)
    spectrum[_HARMONICS + 1 :] = 0.0
    smooth = np.fft.irfft(spectrum, _POINTS, axis=0)
    return np.concatenate((smooth, smooth[:1]))


def _motion(subject: _Subject, part: slice, probe: int) -> tuple[Floats, Floats]:
    """Position in um and velocity in mm/s through a mean revolution, up to the eighth harmonic."""
    mean = subject.orbits(part)[:, :_POINTS, probe].mean(axis=0)
    turns_per_s = subject.rate_hz / float(subject.trace.vectors.period_samples[part].mean())
    spectrum = np.fft.rfft(mean)
    spectrum[_HARMONICS + 1 :] = 0.0  # differentiation would show nothing but noise above
    velocity = np.fft.irfft(spectrum * 2j * math.pi * turns_per_s * np.arange(len(spectrum)), _POINTS) / 1e3
    place = np.fft.irfft(spectrum, _POINTS)
    return np.append(place, place[0]), np.append(velocity, velocity[0])


def _probabilities(subject: _Subject) -> Figure:
    figure = _figure(subject, "Probabilities", (9.6, 4.8))
    axes = figure.add_subplot()
    analysis = subject.analysis
    end = analysis.revolutions
    edges, levels = [float(subject.calibration.revolutions)], [{"normal": 1.0}]
    for step in analysis.history:
        edges.append(float(step.revolution))
        levels.append(
            {"normal": 1.0}
            if step.verdict == "normal"
            else {str(k): p for k, p in step.probabilities.items()}
        )
    edges.append(float(end))
    shown = [name for name in VERDICTS if any(level.get(name, 0.0) > 0.005 for level in levels)]
    for name in shown:
        heights = [level.get(name, 0.0) if level else math.nan for level in levels]
        style = "--" if name == "damping_loss" else "-"  # it lies on unbalance where they are one group
        axes.step(
            edges,
            [*heights, heights[-1]],
            style,
            where="post",
            color=_COLOURS[name],
            linewidth=2.0,
            label=name.replace("_", " "),
        )
    for i, level in enumerate(levels):
        if not level:
            axes.axvspan(edges[i], edges[i + 1], color=_QUIET, alpha=0.2, linewidth=0)
    axes.axvspan(0, subject.calibration.revolutions, color=_HEALTHY, alpha=0.08, linewidth=0)
    axes.set_ylim(-0.03, 1.03)
    axes.set_ylabel("probability")
    _over_revolutions(axes, subject)
    _legend_below(figure, axes)
    return figure


def _innovations(subject: _Subject) -> Figure:
    figure = _figure(subject, "Innovations and departure test", (9.6, 7.0))
    upper, lower = figure.subplots(2, 1, sharex=True)
    calibration = subject.calibration
    moved, _ = compensated(
        subject.trace.vectors, calibration.rotor, calibration.speed_rad_s, subject.rate_hz, calibration.law
    )
    deviation = np.sqrt(calibration.spread.of_means(1.0, float(calibration.revolutions)))
    innovation = np.abs(moved - calibration.baseline) / deviation
    for k, name in enumerate(_COMPONENTS):
        if not (innovation[:, k] > 0.0).any():
            continue  # as the mean of probes without one: a logarithmic axis has no place for it
        upper.plot(subject.revolutions, innovation[:, k], linewidth=1.2, label=name)
    upper.set_yscale("log")
    upper.set_ylim(0.03, 5.0 * max(10.0, float(np.nanmax(innovation))))  # leaves room for the legend
    upper.set_ylabel("change of the synchronous vector\nin standard deviations")
    upper.grid(alpha=0.3)
    upper.legend(loc="upper left", fontsize=9, ncols=5)
    # While a new segment settles nothing is tested: a gap.
    tests = [report.evidence for report in subject.trace.reports]
    nats = [math.nan if test is None else max(test.nats, _LEAST_NATS) for test in tests]
    energy = [math.nan if test is None else max(test.energy_nats, _LEAST_NATS) for test in tests]
    lower.plot(subject.revolutions, nats, color=_HEALTHY, label="synchronous vector, T")
    lower.plot(subject.revolutions, energy, color=_COLOURS["unbalance"], linewidth=1.0, label="energy")
    lower.axhline(
        subject.analysis.threshold_nats,
        color="black",
        linestyle="--",
        linewidth=1.0,
        label=f"threshold {subject.analysis.threshold_nats:.1f} nats",
    )
    for number, (first, last) in enumerate(_new_references(subject)):
        label = "compared with the changed machine" if number == 0 else None
        lower.axvspan(first, last, color=_QUIET, alpha=0.2, linewidth=0, label=label)
    lower.set_yscale("log")
    lower.set_ylabel("evidence for a change in nats")
    _over_revolutions(lower, subject)
    _legend_below(figure, lower)
    return figure


def _new_references(subject: _Subject) -> list[tuple[int, int]]:
    """From which to which revolution the test holds the machine against itself after a change."""
    stretches: list[tuple[int, int]] = []
    changed = False
    for report in subject.trace.reports:
        if report.state != "departed" or report.departed:
            changed = False
        elif report.evidence is not None:
            begin = stretches.pop()[0] if changed else report.revolution - 1
            stretches.append((begin, report.revolution))
            changed = True
    return stretches


def _over_revolutions(axes: Axes, subject: _Subject) -> None:
    analysis = subject.analysis
    for instant, colour, label in (
        (analysis.onset, _QUIET, "onset"),
        (analysis.departure, _NOW, "alarm"),
        (analysis.declaration, "black", "named"),
    ):
        if instant is not None:
            axes.axvline(
                instant.revolution,
                color=colour,
                linestyle=":",
                linewidth=1.4,
                label=f"{label}, revolution {instant.revolution}",
            )
    axes.set_xlim(0, analysis.revolutions)
    axes.set_xlabel("revolution")
    axes.grid(alpha=0.3)


def _legend_below(figure: Figure, axes: Axes, columns: int = 4) -> None:
    """What the axes show, below all of them: the layout makes room for a legend of the figure only."""
    handles, labels = axes.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", fontsize=9, ncols=columns, frameon=False)


def _polar(subject: _Subject) -> Figure:
    figure = _figure(subject, "1X vector in um by revolution", (6.6, 6.8))
    axes = figure.add_subplot(projection="polar")
    assert isinstance(axes, PolarAxes)  # noqa: S101 - what the projection makes
    forward = subject.trace.vectors.vectors[:, 1]
    drawn = axes.scatter(
        np.angle(forward),
        np.abs(forward),
        c=subject.revolutions,
        cmap="viridis",
        s=12,
        linewidths=0,
        zorder=2,
    )
    figure.colorbar(drawn, ax=axes, label="revolution", shrink=0.7, pad=0.1)
    calibration = subject.calibration
    baseline = complex(calibration.baseline[1])
    spread = 2.0 * math.sqrt(float(calibration.spread.of_means(1.0, calibration.revolutions)[1]))
    circle = baseline + spread * np.exp(1j * np.linspace(0.0, 2.0 * math.pi, 121))
    axes.plot(np.angle(circle), np.abs(circle), color=_HEALTHY, linewidth=1.4)
    _arrow(axes, baseline, _HEALTHY)
    handles = [
        Line2D([], [], color=_HEALTHY, linewidth=2.0, label=f"baseline {abs(baseline):.4g} um, 2 sigma"),
    ]
    if subject.analysis.onset is not None:
        now = complex(forward[subject.last].mean())
        _arrow(axes, now, _NOW)
        handles.append(Line2D([], [], color=_NOW, linewidth=2.0, label=f"last {abs(now):.4g} um"))
    axes.set_rlabel_position(22.5)
    axes.set_rmax(1.1 * float(np.abs(forward).max()))
    figure.legend(handles=handles, loc="outside lower center", fontsize=9, ncols=2, frameon=False)
    return figure


def _arrow(axes: PolarAxes, vector: complex, colour: str) -> None:
    angle, length = math.atan2(vector.imag, vector.real), abs(vector)
    axes.annotate(
        "",
        xy=(angle, length),
        xytext=(0.0, 0.0),
        arrowprops={"arrowstyle": "-|>", "color": colour, "linewidth": 2.0, "shrinkA": 0, "shrinkB": 0},
        zorder=3,
    )
