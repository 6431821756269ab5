"""The reliability diagram of docs/plants.md: how often a first name is true, by its probability."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import TYPE_CHECKING

import matplotlib as mpl
from matplotlib.figure import Figure

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

_EDGES = (0.0, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95, 1.0001)
_Z = 1.96


def interval(true: int, count: int) -> tuple[float, float]:
    """Wilson's interval of a share, of 95 %."""
    share, square = true / count, _Z**2
    middle = (share + square / (2 * count)) / (1 + square / count)
    half = _Z / (1 + square / count) * math.sqrt(share * (1 - share) / count + square / (4 * count**2))
    return max(0.0, middle - half), min(1.0, middle + half)


def draw(parts: Mapping[str, Sequence[tuple[float, bool]]], path: Path) -> None:
    """Draw how often names are true over the probability that they were given with.

    Args:
        parts: by what they are called, probability and truth of every name.
        path: of the SVG.
    """
    with mpl.rc_context({"svg.hashsalt": "plants", "svg.fonttype": "none", "font.size": 9}):
        figure = Figure(figsize=(4.6, 3.6), layout="constrained")
        axes = figure.add_subplot()
        axes.plot([0, 1], [0, 1], color="0.7", linewidth=1, label="probabilities that hold")
        for color, (part, names) in zip(("#1f6fb4", "#c8501e"), parts.items(), strict=False):
            points = []
            for low, high in pairwise(_EDGES):
                at = [(p, right) for p, right in names if low <= p < high]
                if at:
                    count, true = len(at), sum(right for _, right in at)
                    points.append(
                        (sum(p for p, _ in at) / count, true / count, *interval(true, count), count)
                    )
            x, y, low_y, high_y, counts = zip(*points, strict=True)
            below = [max(b - a, 0.0) for a, b in zip(low_y, y, strict=True)]
            above = [max(b - a, 0.0) for a, b in zip(y, high_y, strict=True)]
            axes.errorbar(
                x,
                y,
                [below, above],
                color=color,
                marker="o",
                markersize=4,
                capsize=2,
                linewidth=1,
                label=part,
            )
            for i, (x_at, y_at, count) in enumerate(zip(x, y, counts, strict=True)):
                axes.annotate(
                    str(count), (x_at, y_at), (4, -10 - 9 * (i % 2)), textcoords="offset points", fontsize=7
                )
        axes.set(
            xlim=(0, 1.02),
            ylim=(0, 1.02),
            xlabel="probability of the first name",
            ylabel="share that is true",
        )
        axes.legend(loc="upper left", frameon=False)
        figure.savefig(path, metadata={"Date": None})
