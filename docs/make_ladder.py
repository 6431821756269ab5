"""Make docs/several-machines.svg from the table of ``make bench`` in docs/several-machines.md.

Paste the table there, then: ``python docs/make_ladder.py``.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import matplotlib as mpl
from matplotlib.figure import Figure

PAGE = Path(__file__).with_name("several-machines.md")
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
    Panel("resident memory, MB", 3, (150.0, 150.0 + 63 * 3.0), "150 MB and 3 MB for each further"),
    Panel("loop lag p99, ms", 5, (10.0, 10.0), "10 ms"),
)


def table() -> list[list[float]]:
    """The rows of the table as numbers; what is empty is 0."""
    lines = PAGE.read_text("utf-8").partition(HEADER)[2].splitlines()[2:]
    rows = [line.strip("| ").split("|") for line in lines[: lines.index("")]]
    return [[float(cell.strip() or 0.0) for cell in row] for row in rows]


def main() -> None:
    """Draw and save."""
    rows = table()
    machines = [row[0] for row in rows]
    # Text stays text: no outlines of letters, and the reader's own font.
    mpl.rcParams.update({"svg.fonttype": "none", "svg.hashsalt": "ladder", "font.size": 9})
    figure = Figure(figsize=(9.0, 2.8), layout="constrained")
    for panel, axes in zip(PANELS, figure.subplots(1, len(PANELS)), strict=True):
        axes.plot(machines, [row[panel.column] for row in rows], "o-", color="tab:blue", label="measured")
        axes.plot(machines[:: len(machines) - 1], panel.most, "--", color="tab:red", label=panel.limit)
        axes.set_title(panel.title, fontsize=10)
        axes.set_xlabel("machines in one service")
        axes.set_xticks(machines)
        axes.set_xlim(0.0, 1.05 * machines[-1])
        axes.set_ylim(0.0, 1.25 * max(*panel.most, *(row[panel.column] for row in rows)))
        axes.grid(visible=True, alpha=0.3)
        axes.legend(loc="upper left", fontsize=8, frameon=False)
    figure.savefig(PAGE.with_suffix(".svg"), metadata={"Date": None})


if __name__ == "__main__":
    main()
