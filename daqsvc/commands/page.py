"""``daqsvc page``: the machines of this box, or snapshots of them, in a browser."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from daqsvc.commands.arguments import EXIT_FAILED, EXIT_OK, EXIT_REFUSED, EXIT_USAGE
from daqsvc.commands.store_argument import BadFileError, StoreNotFoundError, add_store, chosen_store

if TYPE_CHECKING:
    from collections.abc import Sequence

    from daqsvc.commands.machine_files import Load
    from daqsvc.page.recorded import SnapshotSource

PORT = 8420
LOOPBACK = "127.0.0.1"
HIGHEST_PORT = 65_535


class PageCommand:
    """``daqsvc page [FILE | --store DIR]``, ``daqsvc page --snapshot FILE...``.

    Args:
        load: reads a machine file; None after its errors have been printed.
    """

    help = "the machines of this box, in a browser"
    description = (
        "Show the machines that the service on this box watches in a web page: what they do, what is wrong "
        "with them and how sure that is; orbit, waveform and spectra. The page is a process of its own: the "
        "service does not wait for it. It can be opened from this box only. Needs the extra 'page'."
    )

    def __init__(self, load: Load) -> None:
        self._load = load

    def add_arguments(self, parser: argparse.ArgumentParser) -> None:
        """See `daqsvc.cli.Command.add_arguments`."""
        self._parser = parser
        parser.add_argument(
            "--snapshot",
            type=Path,
            action="append",
            metavar="FILE",
            help="show a snapshot of the recorder in place of a service, played again and again; may be "
            "repeated, e.g. for a healthy one beside it",
        )
        parser.add_argument(
            "--port", type=_port, default=PORT, help=f"where it listens on {LOOPBACK} (default: {PORT})"
        )
        add_store(parser, of_a_machine=False)

    def run(self, arguments: argparse.Namespace) -> int:
        """See `daqsvc.cli.Command.run`."""
        if arguments.snapshot is not None and (arguments.file or arguments.store):
            self._parser.error("--snapshot shows no service: leave the machine file and --store out")
        try:
            from daqsvc.page.recorded import NoPictureError  # noqa: PLC0415 - an extra
            from daqsvc.page.serving import PortError, serve  # noqa: PLC0415
            from daqsvc.page.source import BoxSource  # noqa: PLC0415
            from daqsvc.snapshots.reading import SnapshotError  # noqa: PLC0415
        except ModuleNotFoundError as error:
            return _failed(f"{error.name} is missing: install it with pip install 'daqsvc[page]'")
        try:
            if arguments.snapshot is not None:
                serve(_of_snapshots(arguments.snapshot), "snapshots", LOOPBACK, arguments.port)
            else:
                store = chosen_store(arguments, self._load).directory
                serve(BoxSource(store), f"{store}", LOOPBACK, arguments.port)
        except BadFileError:
            return EXIT_USAGE
        except (StoreNotFoundError, PortError) as error:
            return _failed(f"{error}")
        except (SnapshotError, NoPictureError) as error:
            _failed(f"{error}")
            return EXIT_REFUSED
        return EXIT_OK


def _of_snapshots(files: Sequence[Path]) -> SnapshotSource:
    """Snapshots by the names of their files.

    Raises:
        SnapshotError: one cannot be read.
        NoPictureError: one lacks what is needed.
    """
    from daqsvc.confined.limits import ResourceLimits  # noqa: PLC0415 - only what a verb needs
    from daqsvc.page.recorded import SnapshotSource  # noqa: PLC0415
    from daqsvc.snapshots.reading import read_snapshot  # noqa: PLC0415

    return SnapshotSource({file.stem: read_snapshot(file, ResourceLimits()) for file in files})


def _failed(why: str) -> int:
    print(f"daqsvc page: {why}", file=sys.stderr)  # noqa: T201 - errors go to stderr
    return EXIT_FAILED


def _port(text: str) -> int:
    if text.isascii() and text.isdecimal() and int(text) <= HIGHEST_PORT:
        return int(text)
    raise argparse.ArgumentTypeError(f"{text!r} is no port: give a number from 0 to {HIGHEST_PORT}")
