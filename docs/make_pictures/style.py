"""What all pictures have in common: width, colours, boxes and arrows, and how they are written."""

from __future__ import annotations

from typing import TYPE_CHECKING

import matplotlib as mpl
from matplotlib.figure import Figure
from matplotlib.patches import FancyArrowPatch, FancyBboxPatch

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from matplotlib.axes import Axes

WIDTH_IN = 7.3
"""700 pixels in a browser: an SVG has 96 to the inch."""
# Okabe and Ito's colours: told apart by everybody, and in grey.
HEALTHY, FAULTY, GOOD = "#0072b2", "#d55e00", "#009e73"
BLACK, QUIET, PALE = "#222222", "#7a7a7a", "#eef3f7"
OTHERS = ("#0072b2", "#009e73", "#e69f00", "#d55e00", "#cc79a7", "#56b4e9")


def use() -> None:
    """Set what every picture has: text stays text, and the same run gives the same file."""
    mpl.rcParams.update(
        {
            "svg.fonttype": "none",
            "svg.hashsalt": "daqsvc",
            "font.family": "sans-serif",
            "font.size": 9.5,
            "axes.spines.top": False,
            "axes.spines.right": False,
            "axes.grid": True,
            "grid.alpha": 0.25,
            "legend.frameon": False,
            "legend.fontsize": 9,
            "axes.titlesize": 10,
            "axes.titlelocation": "left",
        }
    )


def new(height_in: float) -> Figure:
    """An empty picture of the common width."""
    return Figure(figsize=(WIDTH_IN, height_in), layout="constrained", facecolor="white")


def blank(figure: Figure, width: float, height: float) -> Axes:
    """Axes without any marks that fill a picture of boxes; one unit is as long across as up."""
    figure.set_layout_engine("none")
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.set_xlim(0.0, width)
    axes.set_ylim(0.0, height)
    axes.set_axis_off()
    return axes


def box(
    axes: Axes, centre: tuple[float, float], size: tuple[float, float], lines: Sequence[str], color: str
) -> None:
    """A rounded box with a title and further lines of text below it."""
    (x, y), (w, h) = centre, size
    axes.add_patch(
        FancyBboxPatch(
            (x - w / 2, y - h / 2),
            w,
            h,
            boxstyle="round,pad=0,rounding_size=6",
            facecolor=PALE,
            edgecolor=color,
            linewidth=1.3,
        )
    )
    step = 14.0
    top = y + step * (len(lines) - 1) / 2
    for number, line in enumerate(lines):
        axes.text(
            x,
            top - step * number,
            line,
            ha="center",
            va="center",
            fontsize=10 if number == 0 else 8,
            fontweight="bold" if number == 0 else "normal",
            color=BLACK if number == 0 else QUIET,
        )


def arrow(
    axes: Axes,
    begin: tuple[float, float],
    end: tuple[float, float],
    *,
    bend: float = 0.0,
    color: str = BLACK,
    dashed: bool = False,
) -> FancyArrowPatch:
    """An arrow from one place to another, bent to one side if asked."""
    patch = FancyArrowPatch(
        begin,
        end,
        arrowstyle="-|>",
        mutation_scale=11,
        connectionstyle=f"arc3,rad={bend}",
        color=color,
        linewidth=1.2,
        linestyle="--" if dashed else "-",
        shrinkA=0,
        shrinkB=0,
    )
    axes.add_patch(patch)
    return patch


def save(figure: Figure, path: Path) -> None:
    """Write a picture; without the day on which it was made."""
    figure.savefig(path, metadata={"Date": None, "Creator": None})
