"""Figures of what a rotor bank stated over a recording; need matplotlib."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from matplotlib.figure import Figure

from daqsvc.diagnosis.recorded import shortened

if TYPE_CHECKING:
    from collections.abc import Iterable

    from daqsvc.diagnosis.recorded import Statements
    from daqsvc.recording.recording import Recording

_DPI = 110
_LEAD = "lead."
_MOST_NATS = 200.0


def draw_bank(recording: Recording, statements: Statements, modes: Iterable[str], prefix: str) -> list[str]:
    """Write probabilities and evidence of the modes over the revolutions, as a PNG file.

    Args:
        recording: the recording.
        statements: all that the bank stated.
        modes: names of its modes; what it states besides is drawn, too.
        prefix: what the file's name begins with, directory included.

    Returns:
        The file, or nothing if there was no good statement.
    """
    good = [one for one in statements.diagnoses if one.quality == "good" and one.revolutions is not None]
    if not good:
        return []
    figure = Figure(figsize=(9.6, 7.0), layout="constrained")
    figure.suptitle(f"Rotor bank: {shortened(recording.source.name)}\n{good[-1].decision}", fontsize=11)
    upper, lower = figure.subplots(2, 1, sharex=True)
    turns = np.array([one.revolutions for one in good], dtype=np.float64)
    others = (name for one in good for name, probability in one.probabilities.items() if probability)
    for mode in dict.fromkeys((*modes, *others)):
        probability = [one.probabilities.get(mode, np.nan) for one in good]
        (line,) = upper.step(turns, probability, where="post", linewidth=1.8, label=mode)
        lead = [one.evidence.get(_LEAD + mode, np.nan) for one in good]
        lower.plot(turns, np.minimum(lead, _MOST_NATS), color=line.get_color(), linewidth=1.2)
    for change in statements.changes():
        if change.revolutions is not None and change.quality == "good":
            for axes in (upper, lower):
                axes.axvline(change.revolutions, color="#8c8c8c", linestyle=":", linewidth=1.2)
    upper.set_ylim(-0.03, 1.03)
    upper.set_ylabel("probability")
    lower.set_ylabel(
        f"innovations' evidence of the declared\nmode over each other, nats, up to {_MOST_NATS:g}"
    )
    lower.set_xlabel("revolution (dotted: the decision changes)")
    for axes in (upper, lower):
        axes.grid(alpha=0.3)
    figure.legend(loc="outside lower center", fontsize=9, ncols=6, frameon=False)
    file = f"{prefix}.png"
    figure.savefig(file, dpi=_DPI)
    return [file]
