"""The studies that ``daqsvc reproduce`` runs, in the order of the paper's figures."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING

from sim_hw.reproduce.bearing import experiment as bearing_experiment
from sim_hw.reproduce.bearing import figures as bearing_figures
from sim_hw.reproduce.bearing import statements as bearing_statements
from sim_hw.reproduce.results import Findings
from sim_hw.reproduce.rotor import experiment as rotor_experiment
from sim_hw.reproduce.rotor import figures as rotor_figures
from sim_hw.reproduce.rotor import statements as rotor_statements

if TYPE_CHECKING:
    from collections.abc import Callable


@dataclass(frozen=True, slots=True)
class Study:
    """A group of the paper's figures that come from one experiment.

    Attributes:
        title: what it is about.
        run: does the experiment with a seed and a signal-to-noise ratio in dB.
    """

    title: str
    run: Callable[[int, float], Findings]


def rotor_study(seed: int, snr_db: float) -> Findings:
    """The rotor as a whole: rows and figures.

    Args:
        seed: of the sensor noise.
        snr_db: of the probes in the figures; the statistics are at -5, 0 and 5 dB.
    """
    experiment = rotor_experiment.run(seed, snr_db)
    return Findings(
        rows=rotor_statements.rows(experiment),
        figures={
            "fig4": partial(rotor_figures.observer, experiment=experiment, mode="N"),
            "fig5": partial(rotor_figures.observer, experiment=experiment, mode="F1L3"),
            "fig6": partial(rotor_figures.probabilities, experiment=experiment, modes=("N", "F1")),
            "fig7": partial(rotor_figures.probabilities, experiment=experiment, modes=("F1L2", "F1L3")),
        },
    )


def bearing_study(seed: int, snr_db: float) -> Findings:
    """The bearing as a whole: rows and figures.

    Args:
        seed: of the simulated machine.
        snr_db: of its sensors; the figures themselves have no noise, as the paper's.
    """
    experiment = bearing_experiment.run(seed, snr_db)
    return Findings(
        rows=bearing_statements.rows(experiment),
        figures={
            "fig8": partial(bearing_figures.free, experiment=experiment),
            "fig9": partial(bearing_figures.driven, experiment=experiment, fault="outer"),
            "fig10": partial(bearing_figures.driven, experiment=experiment, fault="inner"),
        },
    )


STUDIES: tuple[Study, ...] = (
    Study("rub impact of a rotor that loses its damping (figs 4 to 7)", rotor_study),
    Study("raceway faults of a rolling element bearing (figs 8 to 10)", bearing_study),
)
