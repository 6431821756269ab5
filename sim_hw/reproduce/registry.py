"""The studies that ``daqsvc reproduce`` runs, in the order of the paper's figures."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from sim_hw.reproduce.bearing.study import study as bearing_study
from sim_hw.reproduce.rotor.study import study as rotor_study

if TYPE_CHECKING:
    from collections.abc import Callable

    from sim_hw.reproduce.results import Findings


@dataclass(frozen=True, slots=True)
class Study:
    """A group of the paper's figures that come from one experiment.

    Attributes:
        title: what it is about.
        run: does the experiment with a seed and a signal-to-noise ratio in dB.
    """

    title: str
    run: Callable[[int, float], Findings]


STUDIES: tuple[Study, ...] = (
    Study("rub impact of a rotor that loses its damping (figs 4 to 7)", rotor_study),
    Study("raceway faults of a rolling element bearing (figs 8 to 10)", bearing_study),
)
