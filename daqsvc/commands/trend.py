"""``daqsvc trend``: what figures were over hours or months, from the history on the box."""

from __future__ import annotations

import argparse
import csv
import errno
import fnmatch
import importlib.util
import json
import os
import shutil
import stat
import sys
import tempfile
import time
from contextlib import contextmanager
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, TypedDict

from daqsvc.commands.arguments import EXIT_OK, EXIT_USAGE, add_overwrite, duration
from daqsvc.commands.complaint import complain
from daqsvc.commands.store_argument import BadFileError, StoreNotFoundError, add_store, chosen_store
from daqsvc.errors.command_line import (
    ARGUMENTS,
    CANNOT_READ,
    CANNOT_WRITE,
    EXTRA_MISSING,
    NO_SUCH_MACHINE,
    NOTHING_RECORDED,
    THERE_ALREADY,
    WRONG_VALUE,
)

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator
    from typing import TextIO

    from daqsvc.commands.machine_files import Load
    from daqsvc.errors.code import Code
    from daqsvc.history.file import HistoryReader, Series
    from daqsvc.history.points import Step, TrendPoints

SINCE = "1d"
SECONDS_UP_TO_S, MINUTES_UP_TO_S = 2 * 3600, 10 * 86_400
"""The step, where none is stated, by the time that is shown."""
BARS = "▁▂▃▄▅▆▇█"
LEAST_BARS, MOST_BARS = 8, 40
FIGURES = ("low", "mean", "high")
COLUMNS = ("time", "machine", "reading", "unit", *FIGURES)
EXTRAS = {"parquet": ("pyarrow", "parquet"), "plot": ("matplotlib", "plot")}
"""By option, the library that it needs, and the extra that brings it."""
PICTURES = (".png", ".svg", ".pdf")
OF_STDOUT = {errno.EPIPE, errno.ENOSPC, errno.EIO}
"""What `daqsvc.cli.main` states of standard output in its own words."""


class TrendLine(TypedDict):
    """One figure over the time shown; lists of the same length have an entry for each point.

    Attributes:
        schema: what the line is, and of which version.
        machine: name of the machine.
        detector: name of the detector.
        kind: what of its statements the figure is, e.g. `statistics` or `probabilities`.
        key: name of the figure within that.
        unit: unit of the figure; empty if it has none.
        reading: detector and name of the figure, as `--reading` takes it.
        step_s: time from point to point, in s.
        t_s: begin of each point, s since the Unix epoch.
        low: least value of each point.
        mean: mean of each point.
        high: greatest value of each point.
    """

    schema: Literal["daqsvc.trend/1"]
    machine: str
    detector: str
    kind: str
    key: str
    unit: str
    reading: str
    step_s: int
    t_s: list[int]
    low: list[float]
    mean: list[float]
    high: list[float]


class NoTrendError(Exception):
    """There is nothing to show, or no place for it; the text states why, and what to do."""

    def __init__(self, message: str, code: Code = NOTHING_RECORDED) -> None:
        super().__init__(message)
        self.code = code


class _ShownSeries(NamedTuple):
    series: Series
    trend: TrendPoints


class TrendCommand:
    """``daqsvc trend [FILE | --store DIR]``.

    Args:
        load: reads a machine file; None after its errors have been printed.
    """

    help = "show levels and other figures over hours or months, from the history on this box"
    description = (
        "Show levels, probabilities and other figures of the past, from the history on this box. The "
        "service keeps it if the machine file has a table [history]; it can be read with and without a "
        "running service. TIME is a time before now (90m, 8h, 30d), or a date and time (2026-11-23, "
        "2026-11-23T14:30), which is local unless it has an offset."
    )

    def __init__(self, load: Load) -> None:
        self._load = load

    def add_arguments(self, parser: argparse.ArgumentParser) -> None:
        """See `daqsvc.cli.Command.add_arguments`."""
        parser.add_argument(
            "--since",
            type=moment,
            default=SINCE,
            metavar="TIME",
            help=f"begin of the time shown (default: {SINCE})",
        )
        parser.add_argument(
            "--until", type=moment, default=None, metavar="TIME", help="end of the time shown (default: now)"
        )
        parser.add_argument(
            "--step",
            choices=("second", "minute", "hour"),
            help="time from point to point (default: it fits the time shown)",
        )
        parser.add_argument(
            "--reading",
            action="append",
            metavar="NAME",
            help="show only this figure, e.g. levels/shaft-x.rms, or all that match '*.rms'; may be repeated",
        )
        form = parser.add_mutually_exclusive_group()
        form.add_argument(
            "--json", action="store_true", help="print one JSON object per line, one for each figure"
        )
        form.add_argument("--csv", type=Path, metavar="FILE", help="write a CSV table; - is standard output")
        form.add_argument("--parquet", type=Path, metavar="FILE", help="write a Parquet table")
        form.add_argument("--plot", type=Path, metavar="FILE", help="draw a picture (.png, .svg, .pdf)")
        form.add_argument(
            "--events", action="store_true", help="print the alarm events instead, one JSON object per line"
        )
        add_overwrite(parser)
        add_store(parser)

    def run(self, arguments: argparse.Namespace) -> int:
        """See `daqsvc.cli.Command.run`."""
        import sqlite3  # noqa: PLC0415 - each verb imports only what it needs

        from daqsvc.history.file import EmptyHistoryError, NewerHistoryError  # noqa: PLC0415

        now_s = time.time()
        since_s, until_s = arguments.since, arguments.until or now_s
        if (problem := _unusable(arguments, since_s, until_s)) is not None:
            what, code = problem
            return complain("daqsvc trend", what, code, EXIT_USAGE)
        try:
            chosen = chosen_store(arguments, self._load)
            store = chosen.directory
            chosen.tell_other("daqsvc trend")
            _tell(store, chosen.machine, arguments, since_s, until_s)
        except BadFileError:
            return EXIT_USAGE
        except (StoreNotFoundError, NoTrendError, NewerHistoryError, EmptyHistoryError) as error:
            return complain("daqsvc trend", error, error.code)
        except sqlite3.Error as error:
            return complain("daqsvc trend", f"the history in {store} cannot be read: {error}", CANNOT_READ)
        except OSError as error:
            # A target is reported already (`_put_whole`): without a name it is standard output.
            if error.filename is None and error.errno in OF_STDOUT:
                raise
            where = "standard output" if error.filename is None else error.filename
            return complain("daqsvc trend", f"{where}: {error.strerror or error}", CANNOT_WRITE)
        return EXIT_OK


def moment(text: str) -> float:
    """``8h`` ago, or a date with or without a time; s since the Unix epoch."""
    try:
        return time.time() - duration(text)
    except argparse.ArgumentTypeError:
        pass
    try:
        return datetime.fromisoformat(text).astimezone().timestamp()
    except (ValueError, OverflowError, OSError):
        raise argparse.ArgumentTypeError(
            f"{text!r} is no time; write e.g. 8h, 30d, 2026-11-23 or 2026-11-23T14:30"
        ) from None


def _unusable(arguments: argparse.Namespace, since_s: float, until_s: float) -> tuple[str, Code] | None:
    """What is wrong with the options together; None if nothing is."""
    for option, (library, extra) in EXTRAS.items():
        if getattr(arguments, option) is not None and importlib.util.find_spec(library) is None:
            return (
                f"--{option} needs {library}; install it with: pip install 'daqsvc[{extra}]'",
                EXTRA_MISSING,
            )
    if since_s >= until_s:
        return "--since is not before --until; write the earlier one as --since", ARGUMENTS
    if arguments.plot is not None and arguments.plot.suffix.lower() not in PICTURES:
        return f"--plot {arguments.plot}: write a name that ends in one of {', '.join(PICTURES)}", WRONG_VALUE
    if str(arguments.parquet) == "-":
        return "--parquet -: write the name of a file; --csv - writes to standard output", WRONG_VALUE
    return _taken(arguments)


def _taken(arguments: argparse.Namespace) -> tuple[str, Code] | None:
    """Why nothing may be written where the options state; None if it may."""
    target: Path | None = arguments.csv or arguments.parquet or arguments.plot
    if target is None or str(target) == "-":
        return None
    try:
        mode = target.stat().st_mode
    except FileNotFoundError:
        return None
    except OSError as error:
        return f"{target}: {error.strerror}; give another name", CANNOT_WRITE
    problem = None
    if stat.S_ISDIR(mode):
        problem = f"{target} is a folder; name a file in it", CANNOT_WRITE
    elif not stat.S_ISREG(mode) and arguments.csv is None:  # a pipe or a device takes a table as it comes
        what = f"{target} is no regular file; give another name, or write a table to it with --csv"
        problem = what, CANNOT_WRITE
    elif stat.S_ISREG(mode) and not arguments.overwrite:
        what = f"{target} is there already; give another name, or --overwrite to replace it"
        problem = what, THERE_ALREADY
    return problem


def _no_history(store: Path, *, by_file: bool) -> str:
    """That a store has no history, and what to do; the store may also not be that of the service."""
    other = (
        "if the service was started with --store, give the same --store in place of FILE"
        if by_file
        else "give the machine file in place of --store, as it names the store"
    )
    return (
        f"there is no history in {store}; write [history] into the machine file, and start the service with "
        f"it; or {other}"
    )


def _tell(
    store: Path, machine: str | None, arguments: argparse.Namespace, since_s: float, until_s: float
) -> None:
    """Show what was asked for.

    Raises:
        NoTrendError: there is nothing.
        NewerHistoryError: a newer version wrote the file.
        EmptyHistoryError: no service has written anything into it.
        sqlite3.Error: it cannot be read.
        OSError: it cannot be opened, or standard output takes no more.
    """
    from daqsvc.history.file import NAME, HistoryReader  # noqa: PLC0415 - brings SQLite and NumPy

    path = store / NAME
    if not path.is_file():
        raise NoTrendError(_no_history(store, by_file=arguments.store is None))
    reader = HistoryReader(path)
    try:
        if arguments.events:
            for event in reader.events(machine, since_s, until_s):
                print(event.payload.decode())  # noqa: T201 - this is what the verb is for
            return
        chosen = _chosen(reader, machine, arguments.reading)
        step = _step(arguments.step, until_s - since_s)
        shown = [_ShownSeries(one, reader.trend(one, step, since_s, until_s)) for one in chosen]
    finally:
        reader.close()
    shown = [one for one in shown if len(one.trend.t_s)]
    if not shown:
        raise NoTrendError(
            f"nothing was stored for these {step.name.lower()}s; ask for another time with --since, or "
            "another --step"
        )
    if arguments.json:
        for one in shown:
            print(json.dumps(_document(one, step)))  # noqa: T201 - as above
    elif arguments.csv is not None:
        _write_csv(arguments.csv, shown, force=arguments.overwrite)
    elif arguments.parquet is not None:
        with _put_whole(arguments.parquet, force=arguments.overwrite) as path:
            _write_parquet(path, shown)
    elif arguments.plot is not None:
        with _put_whole(arguments.plot, force=arguments.overwrite) as path:
            _plot(path, shown)
    else:
        print(_text(shown, step, since_s, until_s, shutil.get_terminal_size().columns))  # noqa: T201


def _chosen(reader: HistoryReader, machine: str | None, readings: list[str] | None) -> list[Series]:
    everything = reader.series()
    machines = sorted({one.machine for one in everything})
    if machine is not None and machine not in machines:
        there = ", ".join(machines) or "none"
        raise NoTrendError(f"no machine {machine!r} in the history; there is {there}", NO_SUCH_MACHINE)
    of_machine = [one for one in everything if machine in {None, one.machine}]
    if readings is None:
        return of_machine
    for pattern in readings:
        if not any(fnmatch.fnmatchcase(one.name, pattern) for one in of_machine):
            names = ", ".join(sorted({one.name for one in of_machine}))
            raise NoTrendError(f"no figure {pattern!r} in the history; there is {names or 'none'}")
    return [one for one in of_machine if any(fnmatch.fnmatchcase(one.name, p) for p in readings)]


def _step(name: str | None, shown_s: float) -> Step:
    from daqsvc.history.points import Step  # noqa: PLC0415 - as above

    if name is not None:
        return Step[name.upper()]
    if shown_s <= SECONDS_UP_TO_S:
        return Step.SECOND
    return Step.MINUTE if shown_s <= MINUTES_UP_TO_S else Step.HOUR


def _text(shown: list[_ShownSeries], step: Step, since_s: float, until_s: float, width: int) -> str:
    import numpy as np  # noqa: PLC0415 - as above

    from daqsvc.commands.tables import aligned, harmless  # noqa: PLC0415

    blocks = []
    for machine in dict.fromkeys(one.series.machine for one in shown):
        rows = []
        for series, trend in (one for one in shown if one.series.machine == machine):
            # A minute with little in it counts for little: the mean is the same at every step.
            mean = np.average(trend.mean.astype(float), weights=trend.n)
            figures = (trend.mean[-1], trend.low.min(), mean, trend.high.max())
            rows.append([series.name, *(f"{figure:.4g}" for figure in figures), series.unit])
        titles = ["reading", "last", "least", "mean", "greatest", "unit"]
        table = aligned([*titles, ""], [[*row, ""] for row in rows]).splitlines()
        bars = min(MOST_BARS, width - max(map(len, table)) - 2)
        if bars >= LEAST_BARS:
            means = [one.trend for one in shown if one.series.machine == machine]
            lines = ["", *(_bars(trend, since_s, until_s, bars) for trend in means)]
            longest = max(map(len, table))
            table = [f"{row.ljust(longest)}  {line}".rstrip() for row, line in zip(table, lines, strict=True)]
        head = f"{harmless(machine)}, {_local(since_s)} to {_local(until_s)}, by the {step.name.lower()}"
        blocks.append("\n".join([head, *table]))
    return "\n\n".join(blocks)


def _bars(trend: TrendPoints, since_s: float, until_s: float, bars: int) -> str:
    """The means as a row of bars from the least to the greatest; a blank where nothing was measured."""
    import numpy as np  # noqa: PLC0415 - as above

    place = ((trend.t_s - since_s) / (until_s - since_s) * bars).astype(int).clip(0, bars - 1)
    counts = np.bincount(place, trend.n, minlength=bars)
    means = np.bincount(place, trend.mean * trend.n, minlength=bars) / np.maximum(counts, 1)
    least, most = means[counts > 0].min(), means[counts > 0].max()
    height = np.round((means - least) / (most - least or 1.0) * (len(BARS) - 1)).astype(int)
    return "".join(BARS[h] if n else " " for h, n in zip(height.clip(0, len(BARS) - 1), counts, strict=True))


def _local(t_s: float) -> str:
    return datetime.fromtimestamp(t_s).astimezone().strftime("%Y-%m-%d %H:%M")


def _document(one: _ShownSeries, step: Step) -> TrendLine:
    series, trend = one
    return {
        "schema": "daqsvc.trend/1",
        "machine": series.machine,
        "detector": series.detector,
        "kind": series.kind,
        "key": series.key,
        "unit": series.unit,
        "reading": series.name,
        "step_s": int(step),
        "t_s": trend.t_s.tolist(),
        "low": _in_short(trend.low),
        "mean": _in_short(trend.mean),
        "high": _in_short(trend.high),
    }


def _in_short(values: Iterable[float]) -> list[float]:
    return [float(f"{value:.6g}") for value in values]


def _rows(shown: Iterable[_ShownSeries]) -> Iterator[tuple[Any, ...]]:
    for series, trend in shown:
        columns = (trend.t_s, trend.low, trend.mean, trend.high)
        for t_s, low, mean, high in zip(*(column.tolist() for column in columns), strict=True):
            yield t_s, series.machine, series.name, series.unit, low, mean, high


@contextmanager
def _put_whole(target: Path, *, force: bool) -> Iterator[Path]:
    """A path beside a target to write to; the file comes to its place when it is whole and on the disk.

    Raises:
        NoTrendError: it cannot be written, or is there meanwhile.
    """
    with _named(target):
        # What a link leads to is replaced, not the link.
        place = Path(os.path.realpath(target))
        with tempfile.TemporaryDirectory(
            prefix=".daqsvc-trend-", dir=place.parent, ignore_cleanup_errors=True
        ) as folder:
            path = Path(folder) / place.name
            yield path
            with path.open("rb") as written:
                os.fsync(written.fileno())
            _put(path, place, force=force)


def _put(path: Path, place: Path, *, force: bool) -> None:
    """Put a file in its place, without force never over one that has come there meanwhile.

    Raises:
        OSError: one has come, or the disk refuses.
    """
    if not force:
        try:
            place.hardlink_to(path)
        except FileExistsError:
            raise
        except OSError:
            pass  # a file system without hard links
        else:
            return
    path.replace(place)


@contextmanager
def _named(target: Path) -> Iterator[None]:
    """What goes wrong here is reported with the target, as the option names it: libraries do not name it so.

    Raises:
        NoTrendError: instead of an OSError.
        BrokenPipeError: whoever read from a pipe has had enough, which is no failure.
    """
    try:
        yield
    except BrokenPipeError:
        raise
    except OSError as error:
        why = os.strerror(error.errno) if error.errno else " ".join(f"{error}".split())
        raise NoTrendError(f"{target}: {why}", CANNOT_WRITE) from error


def _write_csv(path: Path, shown: list[_ShownSeries], *, force: bool) -> None:
    """Write a table: to standard output, a pipe or a device as it comes, else to a file when it is whole.

    Raises:
        NoTrendError: it cannot be written.
        OSError: standard output takes no more.
    """
    if str(path) == "-":
        _write_table(sys.stdout, shown)
    elif path.exists() and not path.is_file():
        with _named(path):
            _write_to(path, shown)
    else:
        with _put_whole(path, force=force) as beside:
            _write_to(beside, shown)


def _write_to(path: Path, shown: list[_ShownSeries]) -> None:
    with path.open("w", encoding="utf-8", newline="") as file:
        _write_table(file, shown)


def _write_table(file: TextIO, shown: list[_ShownSeries]) -> None:
    table = csv.writer(file, lineterminator="\n")
    table.writerow(COLUMNS)
    for t_s, *names, low, mean, high in _rows(shown):
        figures = (f"{figure:.6g}" for figure in (low, mean, high))
        table.writerow([_utc(t_s).isoformat().replace("+00:00", "Z"), *names, *figures])


def _utc(t_s: float) -> datetime:
    return datetime(1970, 1, 1, tzinfo=UTC) + timedelta(seconds=t_s)


def _write_parquet(path: Path, shown: list[_ShownSeries]) -> None:
    import numpy as np  # noqa: PLC0415 - as above
    import pyarrow as pa  # noqa: PLC0415 - an extra
    import pyarrow.parquet as pq  # noqa: PLC0415 - as above

    lengths = [len(one.trend.t_s) for one in shown]
    columns: dict[str, Any] = {
        "time": pa.array(np.concatenate([one.trend.t_s for one in shown]), pa.timestamp("s", tz="UTC"))
    }
    for name, of in (("machine", "machine"), ("reading", "name"), ("unit", "unit")):
        words = [getattr(one.series, of) for one in shown]
        columns[name] = pa.array(np.repeat(np.array(words, object), lengths), pa.string())
    for name in FIGURES:
        columns[name] = pa.array(np.concatenate([getattr(one.trend, name) for one in shown]))
    pq.write_table(pa.table(columns), path)


def _plot(path: Path, shown: list[_ShownSeries]) -> None:
    import matplotlib as mpl  # noqa: PLC0415 - an extra

    mpl.use("Agg")
    import matplotlib.pyplot as plt  # noqa: PLC0415 - as above

    panels: dict[tuple[str, str, str], list[_ShownSeries]] = {}
    for one in shown:
        panels.setdefault((one.series.machine, one.series.detector, one.series.unit), []).append(one)
    figure, axes = plt.subplots(
        len(panels),
        1,
        sharex=True,
        squeeze=False,
        figsize=(10, 1.2 + 1.9 * len(panels)),
        layout="constrained",
    )
    for axis, ((machine, detector, unit), lines) in zip(axes[:, 0], panels.items(), strict=True):
        for series, trend in lines:
            times = [_utc(t_s) for t_s in trend.t_s.tolist()]
            [line] = axis.plot(times, trend.mean, linewidth=1.0, label=series.key)
            axis.fill_between(times, trend.low, trend.high, alpha=0.2, color=line.get_color(), linewidth=0)
        axis.set_title(f"{machine}: {detector}", loc="left", fontsize=9)
        axis.set_ylabel(unit)
        # Figures as they are, and not the difference from a number above the axis.
        axis.ticklabel_format(axis="y", useOffset=False)
        axis.legend(fontsize=7, loc="upper left", bbox_to_anchor=(1.0, 1.0), frameon=False)
        axis.grid(alpha=0.3)
    axes[-1, 0].set_xlabel("time (UTC)")
    figure.autofmt_xdate()
    try:
        figure.savefig(path)
    finally:
        plt.close(figure)
