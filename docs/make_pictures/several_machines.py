"""What machines cost one service, from the table of ``make bench`` in docs/several-machines.md."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from make_pictures.style import FAULTY, HEALTHY, new

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PAGE = Path(__file__).parents[1] / "several-machines.md"
HEADER = "| machines |"


class Panel(NamedTuple):
    """One of the figures over the number of machines.

    Attributes:
        title: what it shows.
        column: of the table.
        most: what it may be with so many machines: value at the first and at the last of them.
        limit: that in words.
    """

    title: str
    column: int
    most: tuple[float, float]
    limit: str


PANELS = (
    Panel("CPU seconds a second", 1, (1.0, 1.0), "one core"),
    Panel("resident memory, MB", 3, (150.0, 150.0 + 63 * 3.0), "150 MB, 3 MB\nfor each further"),
    Panel("loop lag p99, ms", 5, (10.0, 10.0), "10 ms"),
)


def table() -> list[list[float]]:
    """The rows of the table as numbers; what is empty is 0."""
    lines = PAGE.read_text("utf-8").partition(HEADER)[2].splitlines()[2:]
    rows = [line.strip("| ").split("|") for line in lines[: lines.index("")]]
    return [[float(cell.strip() or 0.0) for cell in row] for row in rows]


def picture() -> Figure:
    """Processor, memory and lag over the number of machines, and what each may be."""
    rows = table()
    machines = [row[0] for row in rows]
    figure = new(2.6)
    for panel, axes in zip(PANELS, figure.subplots(1, len(PANELS)), strict=True):
        axes.plot(machines, [row[panel.column] for row in rows], "o-", color=HEALTHY, label="measured")
        limits = np.interp(machines, machines[:: len(machines) - 1], panel.most)
        axes.plot(machines, limits, "--", color=FAULTY, label=panel.limit)
        axes.set_title(panel.title)
        axes.set_xlabel("machines in one service")
        # Each count is four times the one before: evenly spaced, their labels do not touch.
        axes.set_xscale("log")
        axes.set_xticks(machines, [f"{count:g}" for count in machines])
        axes.minorticks_off()
        axes.set_ylim(0.0, 1.4 * max(*panel.most, *(row[panel.column] for row in rows)))
        axes.legend(loc="upper left", fontsize=8)
    return figure
