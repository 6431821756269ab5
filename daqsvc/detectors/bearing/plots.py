"""The envelope spectrum of a bearing, with the lines of its kinematics marked.

Needs matplotlib (``pip install 'daqsvc[plot]'``); imported only by who draws.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.figure import Figure

from daqsvc.bearing.race.verdict import PARTS
from daqsvc.diagnosis.recorded import shortened

if TYPE_CHECKING:
    from collections.abc import Mapping

    from matplotlib.axes import Axes

    from daqsvc.bearing.geometry import BearingOrders
    from daqsvc.bearing.race.verdict import Part, RaceVerdict
    from daqsvc.detectors.bearing.verdict import BearingVerdict

_COLOURS: Mapping[Part, str] = {"inner": "#d55e00", "outer": "#0072b2", "ball": "#009e73"}
_MARKS: Mapping[Part, str] = {"inner": "v", "outer": "s", "ball": "o"}
_QUIET = "#8c8c8c"
_NAMES: Mapping[Part, str] = {"inner": "BPFI", "outer": "BPFO", "ball": "2 BSF"}
_HARMONICS = 4
_DPI = 110


def draw_envelopes(analysis: BearingVerdict, prefix: str) -> list[str]:
    """Write the envelope spectrum of each channel that could be judged as a PNG file.

    Args:
        analysis: the verdict.
        prefix: what the files' names begin with, directory included.

    Returns:
        The files.
    """
    files = []
    for number, (name, race) in enumerate(analysis.races.items()):
        files.append(f"{prefix}-envelope{'' if number == 0 else f'-{number + 1}'}.png")
        _envelope(analysis, name, race).savefig(files[-1], dpi=_DPI)
    return files


def _envelope(analysis: BearingVerdict, name: str, race: RaceVerdict) -> Figure:
    """One channel: the spectrum over orders, its noise floor, and where each part's lines would be."""
    spectrum = race.spectrum
    assert spectrum is not None  # noqa: S101 - the race test of a recording keeps it
    figure = Figure(figsize=(9.6, 5.2), layout="constrained")
    verdict = race.verdict.replace("_", " ")
    figure.suptitle(
        f"Envelope spectrum: {shortened(Path(analysis.recording).name)}, {shortened(name)}\n"
        f"{verdict} (by this channel), {race.speed_rpm:.1f} rpm, {race.revolutions:.0f} revolutions",
        fontsize=11,
    )
    axes = figure.add_subplot()
    last = 1.05 * max(_HARMONICS * race.evidence["inner"].order, _HARMONICS * race.evidence["outer"].order)
    shown = spectrum.order <= last
    axes.plot(spectrum.order[shown], spectrum.amplitude[shown], color="black", linewidth=0.6)
    axes.plot(
        spectrum.order[shown], spectrum.floor[shown], color=_QUIET, linewidth=1.0, label="local noise level"
    )
    _mark(axes, race, analysis.setup.bearings[name], last)
    axes.set_xlim(0.0, last)
    axes.set_ylim(0.0, 1.15 * float(spectrum.amplitude[shown][1:].max()))
    axes.set_xlabel("events per revolution of the shaft")
    axes.set_ylabel("modulation index of the whitened envelope")
    axes.grid(alpha=0.3)
    above = axes.secondary_xaxis(
        "top",
        functions=(
            lambda order: np.multiply(order, race.speed_rpm / 60.0),
            lambda hz: np.divide(hz, race.speed_rpm / 60.0),
        ),
    )
    above.set_xlabel("Hz", fontsize=9)
    handles, labels = axes.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", fontsize=9, ncols=4, frameon=False)
    return figure


def _mark(axes: Axes, race: RaceVerdict, bearing: BearingOrders, last: float) -> None:
    """Where the lines would be, dashed; those that were found, with a mark on top."""
    for part in PARTS:
        e = race.evidence[part]
        label = f"{_NAMES[part]} {e.order:.3f}: z {e.z:.1f}, size {e.depth:.2f}"
        for harmonic in range(1, _HARMONICS + 1):
            axes.axvline(
                harmonic * e.order,
                color=_COLOURS[part],
                linestyle="--",
                linewidth=1.0,
                alpha=0.55 if e.testable else 0.2,
                label=label if harmonic == 1 else None,
            )
        lines = [line for line in race.lines if line.part == part and line.order <= last]
        if lines:
            axes.plot(
                [line.order for line in lines],
                [line.depth for line in lines],
                _MARKS[part],
                color=_COLOURS[part],
                markersize=6,
                markerfacecolor="none",
            )
    for turn in np.arange(1.0, last):
        axes.axvline(turn, color=_QUIET, linewidth=0.5, alpha=0.3, label="shaft" if turn == 1.0 else None)
    axes.axvline(bearing.cage, color=_QUIET, linestyle=":", linewidth=1.2, label=f"cage {bearing.cage:.3f}")
