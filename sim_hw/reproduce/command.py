"""``daqsvc reproduce``: the paper's experiments from scratch, and their results."""

from __future__ import annotations

import argparse
import importlib.util
import json
import sys
import tempfile
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from daqsvc.commands.arguments import EXIT_OK
from daqsvc.commands.complaint import complain
from daqsvc.errors.command_line import CANNOT_WRITE, EXTRA_MISSING
from sim_hw import arguments as arguments_of

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from sim_hw.reproduce.results import Findings, ResultRow

SEED = 1
SNR_DB = 0.0
MOST_DB = 40.0
DPI = 110
_METADATA: Mapping[str, str | None] = {"Software": None}
"""The same run gives the same bytes, whatever the version of matplotlib calls itself."""


class ReproduceCommand:
    """The verb ``reproduce`` (entry-point group ``daqsvc.commands``)."""

    help = "run the paper's experiments: its figures, and its values beside those obtained"
    description = (
        "Run the paper's experiments from scratch, in less than two minutes. Write its figures "
        "(fig4.png to fig10.png) and a table of the paper's values beside those obtained (results.md, "
        "results.csv), and print the table."
    )

    def add_arguments(self, parser: argparse.ArgumentParser) -> None:
        """See `daqsvc.cli.Command.add_arguments`."""
        parser.add_argument(
            "--out",
            type=Path,
            required=True,
            metavar="DIR",
            help="directory for figures and tables; it is made if it does not exist",
        )
        parser.add_argument(
            "--seed",
            type=arguments_of.whole,
            default=SEED,
            metavar="N",
            help=f"seed of the sensor noise (default: {SEED})",
        )
        parser.add_argument(
            "--snr-db",
            type=snr_db,
            default=SNR_DB,
            metavar="DB",
            help="signal-to-noise ratio of the probes in the figures, in dB; the paper has -5 to 5 dB "
            f"(default: {SNR_DB:g})",
        )
        parser.add_argument(
            "--json",
            action="store_true",
            help="print one JSON object per line, one for each row of the table",
        )

    def run(self, arguments: argparse.Namespace) -> int:
        """See `daqsvc.cli.Command.run`."""
        from daqsvc import kernel_cache  # noqa: PLC0415
        from daqsvc.cli import start_logging  # noqa: PLC0415

        start_logging(verbose=False)
        if importlib.util.find_spec("matplotlib") is None:
            what = "the figures need matplotlib; install it with: pip install 'daqsvc[plot]'"
            return complain("daqsvc reproduce", what, EXTRA_MISSING)
        out: Path = arguments.out
        if problem := _cannot_write_into(out):
            return complain("daqsvc reproduce", problem, CANNOT_WRITE)
        kernel_cache.prepare()
        try:
            rows = _reproduce(out, arguments.seed, arguments.snr_db)
        except OSError as error:
            where = error.filename or out
            what = f"{where} cannot be written: {error.strerror}; free it, or name another --out"
            return complain("daqsvc reproduce", what, CANNOT_WRITE)
        _print(rows, as_json=arguments.json)
        _note(f"figures and tables are in {out}")
        return EXIT_OK


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
    from sim_hw.reproduce.results import Findings  # noqa: PLC0415
    from sim_hw.reproduce.rotor import experiment, figures, statements  # noqa: PLC0415

    done = experiment.run(seed, snr_db)
    return Findings(
        rows=statements.rows(done),
        figures={
            "fig4": partial(figures.observer, experiment=done, mode="N"),
            "fig5": partial(figures.observer, experiment=done, mode="F1L3"),
            "fig6": partial(figures.probabilities, experiment=done, modes=("N", "F1")),
            "fig7": partial(figures.probabilities, experiment=done, modes=("F1L2", "F1L3")),
        },
    )


def bearing_study(seed: int, snr_db: float) -> Findings:
    """The bearing as a whole: rows and figures.

    Args:
        seed: of the simulated machine.
        snr_db: of its sensors; the figures themselves have no noise, as the paper's.
    """
    from sim_hw.reproduce.bearing import experiment, figures, statements  # noqa: PLC0415
    from sim_hw.reproduce.results import Findings  # noqa: PLC0415

    done = experiment.run(seed, snr_db)
    return Findings(
        rows=statements.rows(done),
        figures={
            "fig8": partial(figures.free, experiment=done),
            "fig9": partial(figures.driven, experiment=done, fault="outer"),
            "fig10": partial(figures.driven, experiment=done, fault="inner"),
        },
    )


STUDIES: tuple[Study, ...] = (
    Study("rub impact of a rotor that loses its damping (figs 4 to 7)", rotor_study),
    Study("raceway faults of a rolling element bearing (figs 8 to 10)", bearing_study),
)
"""What the verb runs, in the order of the paper's figures."""


def snr_db(text: str) -> float:
    """A signal-to-noise ratio at which the figures show something."""
    value = arguments_of.decibels(text)
    if abs(value) > MOST_DB:
        raise argparse.ArgumentTypeError(f"{text!r} is not a number from -{MOST_DB:g} to {MOST_DB:g} dB")
    return value


def _cannot_write_into(out: Path) -> str | None:
    """Why nothing can be written into a directory, which is made if it is new; None if it can."""
    if out.exists() and not out.is_dir():
        return f"--out {out} is not a directory; name another, it is made if it does not exist"
    try:
        out.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=out):
            pass
    except OSError as error:
        return f"--out {out} cannot be written: {error.strerror}; name a directory that can"
    return None


def _reproduce(out: Path, seed: int, snr_db: float) -> list[ResultRow]:
    """Run every study; write figures and tables."""
    from sim_hw.reproduce import results  # noqa: PLC0415

    rows: list[ResultRow] = []
    for study in STUDIES:
        _note(f"{study.title} ...")
        findings = study.run(seed, snr_db)
        rows += findings.rows
        _draw(out, findings)
    heading = (
        f"Written by `daqsvc reproduce --seed {seed} --snr-db {snr_db:g}`. Lengths are in clearances; the "
        "second (s) is the paper's unit of normalised time, 1/omega_s."
    )
    results.write_markdown(out / "results.md", rows, heading=heading)
    results.write_csv(out / "results.csv", rows)
    return rows


def _draw(out: Path, findings: Findings) -> None:
    from matplotlib.figure import Figure  # noqa: PLC0415

    for name, draw in findings.figures.items():
        # No pyplot: nothing global, no display.
        figure = Figure(layout="constrained")
        draw(figure)
        figure.savefig(out / f"{name}.png", dpi=DPI, metadata=_METADATA)


def _note(message: str) -> None:
    """What goes on, for a person who watches."""
    if sys.stderr.isatty():
        print(f"daqsvc reproduce: {message}", file=sys.stderr)  # noqa: T201


def _print(rows: Sequence[ResultRow], *, as_json: bool) -> None:
    from sim_hw.reproduce.results import as_text  # noqa: PLC0415

    for line in [json.dumps(row.as_json()) for row in rows] if as_json else [as_text(rows)]:
        print(line)  # noqa: T201 - this is the output
