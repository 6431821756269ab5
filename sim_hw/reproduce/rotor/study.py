"""The study of the rotor as a whole: rows and figures."""

from __future__ import annotations

from functools import partial

from sim_hw.reproduce.results import Findings
from sim_hw.reproduce.rotor import figures, statements
from sim_hw.reproduce.rotor.experiment import run


def study(seed: int, snr_db: float) -> Findings:
    """Run the experiment and say what came out.

    Args:
        seed: of the sensor noise.
        snr_db: of the probes in the figures; the statistics are at -5, 0 and 5 dB.
    """
    experiment = run(seed, snr_db)
    return Findings(
        rows=statements.rows(experiment),
        figures={
            "fig4": partial(figures.observer, experiment=experiment, mode="N"),
            "fig5": partial(figures.observer, experiment=experiment, mode="F1L3"),
            "fig6": partial(figures.probabilities, experiment=experiment, modes=("N", "F1")),
            "fig7": partial(figures.probabilities, experiment=experiment, modes=("F1L2", "F1L3")),
        },
    )
