"""Figures 8 to 10 of the paper."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from sim_hw.reproduce.bearing.experiment import LATE, RACES, SLOPES, distance

if TYPE_CHECKING:
    from collections.abc import Mapping

    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from numpy.typing import NDArray

    from sim_hw.reproduce.bearing.experiment import BearingExperiment

    Floats = NDArray[np.float64]

# Okabe and Ito's colours, which the colour-blind tell apart.
PATH, SURFACE = {"outer": "#0072B2", "inner": "#D55E00"}, "#222222"


def free(figure: Figure, experiment: BearingExperiment) -> None:
    """Figure 8: the units of a healthy machine, from a start off their surfaces."""
    _draw(figure, experiment, experiment.free, "healthy case")


def driven(figure: Figure, experiment: BearingExperiment, fault: str) -> None:
    """Figures 9 and 10: both units under a fault of one race.

    Args:
        figure: empty figure to draw on.
        experiment: the experiment.
        fault: ``"outer"`` or ``"inner"``.
    """
    paths = {race: experiment.driven[fault, race] for race in RACES}
    _draw(figure, experiment, paths, f"excited by {fault} raceway fault")


def _draw(figure: Figure, experiment: BearingExperiment, paths: Mapping[str, Floats], title: str) -> None:
    figure.set_size_inches(12.0, 9.0)
    planes, distances = figure.subplots(2, 2, height_ratios=(2.0, 1.0))
    figure.suptitle(f"Sliding-mode units, {title}", fontsize=14)
    for letter, race, plane, beside in zip("ab", RACES, planes, distances, strict=True):
        _plane(plane, race, paths[race])
        plane.set_title(f"({letter}) {race} raceway sliding model")
        off = distance(race, paths[race])
        beside.plot(experiment.time, off, color=PATH[race], linewidth=0.8)
        late = np.abs(off[experiment.time >= LATE]).max()
        beside.set(
            title=f"distance from the surface, at most {late:.1e} from time {LATE:g} on",
            xlabel="normalised time",
            ylabel="distance",
        )
    limit = 1.1 * max(np.abs(axis.get_ylim()).max() for axis in distances)
    for axis in (*planes, *distances):
        axis.grid(visible=True, color="#eeeeee")
        axis.set_axisbelow(True)
    for axis in distances:
        axis.set_ylim(-limit, limit)


def _plane(axes: Axes, race: str, path: Floats) -> None:
    reach = 1.15 * np.abs(path).max(axis=0)
    x = np.array([-reach[0], reach[0]])
    axes.plot(x, SLOPES[race] * x, "--", color=SURFACE, linewidth=1.0, label="sliding surface")
    axes.plot(*path.T, color=PATH[race], linewidth=0.9, label="trajectory")
    axes.plot(*path[0], "o", color=PATH[race], markersize=5)
    axes.set(xlabel="$x_1$", ylabel="$x_2$", xlim=x, ylim=(-reach[1], reach[1]))
    axes.legend(loc="upper right", fontsize=9)
