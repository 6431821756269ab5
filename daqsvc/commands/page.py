"""``daqsvc page``: the machines of this box, in a browser."""

from __future__ import annotations

import argparse
import sys
from typing import TYPE_CHECKING

from daqsvc.commands.arguments import EXIT_FAILED, EXIT_OK, EXIT_USAGE
from daqsvc.commands.store_argument import BadFileError, StoreNotFoundError, add_store, chosen_store

if TYPE_CHECKING:
    from daqsvc.commands.machine_files import Load

PORT = 8420
LOOPBACK = "127.0.0.1"
HIGHEST_PORT = 65_535


class PageCommand:
    """``daqsvc page [FILE | --store DIR]``.

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
        parser.add_argument(
            "--port", type=_port, default=PORT, help=f"where it listens on {LOOPBACK} (default: {PORT})"
        )
        add_store(parser, of_a_machine=False)

    def run(self, arguments: argparse.Namespace) -> int:
        """See `daqsvc.cli.Command.run`."""
        try:
            store = chosen_store(arguments, self._load).directory
            from daqsvc.page.serving import PortError, serve  # noqa: PLC0415 - an extra
        except BadFileError:
            return EXIT_USAGE
        except StoreNotFoundError as error:
            return _failed(f"{error}")
        except ModuleNotFoundError as error:
            return _failed(f"{error.name} is missing: install it with pip install 'daqsvc[page]'")
        try:
            serve(store, LOOPBACK, arguments.port)
        except PortError as error:
            return _failed(f"{error}")
        return EXIT_OK


def _failed(why: str) -> int:
    print(f"daqsvc page: {why}", file=sys.stderr)  # noqa: T201 - errors go to stderr
    return EXIT_FAILED


def _port(text: str) -> int:
    if text.isascii() and text.isdecimal() and int(text) <= HIGHEST_PORT:
        return int(text)
    raise argparse.ArgumentTypeError(f"{text!r} is no port: give a number from 0 to {HIGHEST_PORT}")
