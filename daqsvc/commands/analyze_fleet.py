"""``daqsvc analyze ARCHIVE --cluster``: the archive of a fleet, judged on Dask into a table."""

from __future__ import annotations

import argparse
import contextlib
import importlib.util
import json
import os
import signal
import sys
from typing import TYPE_CHECKING, Any, TypedDict

from daqsvc.commands.arguments import EXIT_OK, EXIT_REFUSED, EXIT_USAGE
from daqsvc.commands.complaint import complain
from daqsvc.errors.command_line import EXTRA_MISSING

if TYPE_CHECKING:
    from collections.abc import Iterator

    from daqsvc.fleet.campaign import CampaignSummary

_LIBRARIES = ("distributed", "fsspec", "pyarrow")
_OPTIONS = (
    *("--probes", "--speed-rpm", "--keyphasor", "--keyphasor-threshold", "--natural-frequency-hz"),
    *("--damping-ratio", "--clearance-um", "--static-sag-um", "--ac-coupled", "--follow-orbit", "--channels"),
    *(
        "--baseline",
        "--baseline-map",
        "--baseline-fs",
        "--bearing",
        "--orders",
        "--calibration",
        "--plot",
        "--jobs",
    ),
)
"""What only recordings of one machine have."""


def cluster_address(text: str) -> str:
    """``local``, ``local:N`` or the address of a scheduler."""
    from daqsvc.fleet.cluster import cluster_problem  # noqa: PLC0415 - each verb imports what it needs

    if wrong := cluster_problem(text):
        raise argparse.ArgumentTypeError(wrong)
    return text


def lacking_extra() -> str:
    """What has to be installed first, in a sentence; empty if nothing."""
    absent = [name for name in _LIBRARIES if importlib.util.find_spec(name) is None]
    if not absent:
        return ""
    return f"the archive of a fleet needs {', '.join(absent)}; install them with: pip install 'daqsvc[fleet]'"


def fleet_misuse(arguments: argparse.Namespace) -> str:
    """What is wrong with the options of a fleet together; empty if nothing is."""
    if arguments.cluster is None:
        without = [
            name
            for name in ("--results", "--verify", "--retry")
            if getattr(arguments, name[2:]) not in {None, False}
        ]
        return (
            f"{', '.join(without)}: only with --cluster; leave it out, or name a cluster" if without else ""
        )
    options = [name for name in _OPTIONS if getattr(arguments, name[2:].replace("-", "_")) not in _LEFT_OUT]
    if options:
        return (
            f"{', '.join(options)}: the machine files of the archive state this; leave it out with --cluster"
        )
    if len(arguments.files) > 1:
        places = len(arguments.files)
        return f"--cluster takes one archive, and {places} places are named; give the folder of all"
    if arguments.files[0].lower().endswith(".toml"):
        return f"{arguments.files[0]} is a machine file; with --cluster give the folder of an archive"
    return ""


_LEFT_OUT: tuple[Any, ...] = (None, False, {}, ())


def default_results(archive: str) -> str:
    """Where the results of an archive go, unless another place is named: beside it."""
    place = archive.rstrip("/")
    if place.rpartition("/")[2] in {"", ".", ".."}:
        place = os.path.abspath(archive)  # noqa: PTH100 - what a place is called, wherever links lead
    return f"{place}-results"


class WhereResults(TypedDict):
    """Where the results of an archive are.

    Attributes:
        results: folder or URL of the results.
    """

    results: str


def run_fleet(arguments: argparse.Namespace) -> int:
    """Judge the archive; returns the exit code."""
    if wrong := lacking_extra():
        return complain("daqsvc analyze", wrong, EXTRA_MISSING, EXIT_USAGE)
    from daqsvc.fleet import FleetError  # noqa: PLC0415 - each verb imports what it needs

    try:
        with _ended_by_signal():
            summary, results = _judged(arguments)
    except FleetError as error:
        return complain("daqsvc analyze", error, error.code)
    if arguments.json:
        document: WhereResults = {"results": results}
        print(json.dumps({**summary.as_json(), **document}))  # noqa: T201 - this is what the verb is for
    else:
        print(_text(summary, results))  # noqa: T201
    return EXIT_REFUSED if summary.refused or summary.failed else EXIT_OK


def _judged(arguments: argparse.Namespace) -> tuple[CampaignSummary, str]:
    from daqsvc.fleet.archive import Archive  # noqa: PLC0415
    from daqsvc.fleet.campaign import Campaign, Wanted  # noqa: PLC0415
    from daqsvc.fleet.cluster import connected  # noqa: PLC0415
    from daqsvc.fleet.results import Results  # noqa: PLC0415
    from daqsvc.offline.machine_options import recording_options  # noqa: PLC0415
    from daqsvc.offline.progress import progress_bar  # noqa: PLC0415
    from daqsvc.recording.recording import get_limits, set_memory  # noqa: PLC0415

    set_memory(arguments.max_memory)
    archive = Archive(arguments.files[0])
    results = Results(arguments.results or default_results(arguments.files[0]))
    archive.see_apart(results.url)
    wanted = Wanted(
        recording_options(arguments), get_limits(), verify=arguments.verify, retry=arguments.retry
    )
    with contextlib.ExitStack() as stack:
        stack.enter_context(results.lock())
        bar = stack.enter_context(progress_bar("recordings"))
        campaign = Campaign(archive, results, wanted, bar.update, _say)
        cluster = connected(arguments.cluster, os.cpu_count() or 1)
        summary = campaign.run(lambda: stack.enter_context(cluster))
    return summary, results.url


def _text(summary: CampaignSummary, results: str) -> str:
    from daqsvc.rounding import counted  # noqa: PLC0415 - each verb imports what it needs

    recordings, machines = counted(summary.recordings, "recording"), counted(summary.machines, "machine")
    lines = [
        f"{recordings} of {machines}, {summary.judged:,} judged now",
        *(f"  {verdict}: {number:,}" for verdict, number in summary.verdicts.most_common()),
    ]
    if summary.refused:
        lines.append(f"  not judged: {summary.refused:,} (column reason has the reason; --retry tries again)")
    if summary.others:
        kinds = "is of another kind" if summary.others == 1 else "are of other kinds"
        lines.append(f"{counted(summary.others, 'file')} among the recordings {kinds}")
    if summary.left_out:
        shown = ", ".join(summary.left_out[:5]) + (", ..." if len(summary.left_out) > 5 else "")
        lines.append(f"left out, as no machine's: {shown}")
    failed = list(summary.failed.items())
    lines += [f"not read: {name}: {why}" for name, why in failed[:5]]
    if len(failed) > 5:
        lines.append(f"... of {len(failed):,} machines that were left out; --json has all")
    return "\n".join([*lines, f"results: {results}"])


@contextlib.contextmanager
def _ended_by_signal() -> Iterator[None]:
    """End by SIGTERM as by an error, so that workers end and their folders go."""

    def end(*_: object) -> None:
        raise SystemExit(128 + signal.SIGTERM)

    before = signal.signal(signal.SIGTERM, end)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def _say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)  # noqa: T201 - what goes on is no result
