"""The study of the bearing as a whole: rows and figures."""

from __future__ import annotations

from functools import partial

from sim_hw.reproduce.bearing import figures, statements
from sim_hw.reproduce.bearing.experiment import run
from sim_hw.reproduce.results import Findings


def study(seed: int, snr_db: float) -> Findings:
    """Run the experiment and say what came out.

    Args:
        seed: of the simulated machine.
        snr_db: of its sensors; the figures themselves have no noise, as the paper's.
    """
    experiment = run(seed, snr_db)
    return Findings(
        rows=statements.rows(experiment),
        figures={
            "fig8": partial(figures.free, experiment=experiment),
            "fig9": partial(figures.driven, experiment=experiment, fault="outer"),
            "fig10": partial(figures.driven, experiment=experiment, fault="inner"),
        },
    )
