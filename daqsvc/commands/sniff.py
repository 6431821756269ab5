"""``daqsvc sniff KIND ...``: what is on a bus, before there is any machine file."""

from __future__ import annotations

import json
import sys
from typing import TYPE_CHECKING, TypedDict

from daqsvc.commands.arguments import EXIT_FAILED, EXIT_OK, EXIT_USAGE
from daqsvc.commands.complaint import complain
from daqsvc.commands.plugged import foreign_words, plugged
from daqsvc.commands.stopping import stopping
from daqsvc.errors.command_line import NOTHING_ON_BUS
from daqsvc.errors.machine_file import PLUGIN_FAILED
from drivers.can.sniff import CanSniffer
from drivers.modbus.sniff import ModbusSniffer
from drivers.serial.sniff import SerialSniffer
from drivers.sniffing import Sniffer, SniffError

if TYPE_CHECKING:
    import argparse

    from drivers.sniffing import Sniffed, SniffTable

SNIFFERS = "daqsvc.sniffers"


class SniffEnd(TypedDict):
    """What comes with the figures of every kind of bus.

    Attributes:
        machine_file: tables to begin a machine file with, in TOML; empty if there is nothing to propose.
        problem: what is wrong, with what to check; empty if nothing is.
    """

    machine_file: str
    problem: str


class SniffCommand:
    """``daqsvc sniff KIND ...``; other packages register kinds by entry point in ``daqsvc.sniffers``."""

    help = "show what is on a bus, without a machine file, and print tables to begin one with"
    description = (
        "Show what is on a bus, without a machine file. The output ends with tables to begin a machine "
        "file with. Ctrl-C ends it early, and what was found until then is printed."
    )

    def add_arguments(self, parser: argparse.ArgumentParser) -> None:
        """See `daqsvc.cli.Command.add_arguments`."""
        kinds = parser.add_subparsers(dest="kind", metavar="KIND", required=True, title="verbs")
        for name, sniffer in sniffers().items():
            kind = kinds.add_parser(name, help=sniffer.help, description=sniffer.description)
            sniffer.add_arguments(kind)
            kind.add_argument("--json", action="store_true", help="print one JSON object instead of text")
            kind.set_defaults(sniffer=sniffer)

    def run(self, arguments: argparse.Namespace) -> int:
        """See `daqsvc.cli.Command.run`."""
        sniffer: Sniffer = arguments.sniffer
        try:
            with stopping() as stop:
                sniffed = sniffer.sniff(arguments, stop, _tell)
        except SniffError as error:
            return complain("daqsvc", error, error.code, EXIT_USAGE if error.usage else EXIT_FAILED)
        except Exception as error:
            if (words := foreign_words(error)) is None:
                raise
            return complain("daqsvc", words, PLUGIN_FAILED)
        print(_as_json(sniffed) if arguments.json else _as_text(sniffed))  # noqa: T201 - what the verb is for
        if sniffed.problem:
            sys.stdout.flush()
            return complain("daqsvc", sniffed.problem, NOTHING_ON_BUS)
        return EXIT_OK


def sniffers() -> dict[str, Sniffer]:
    """Every kind of bus that can be examined, by the name of its driver."""
    ours: dict[str, Sniffer] = {"can": CanSniffer(), "serial": SerialSniffer(), "modbus": ModbusSniffer()}
    return ours | plugged(SNIFFERS, Sniffer, "sniff")  # type: ignore[type-abstract]


def _as_json(sniffed: Sniffed) -> str:
    end: SniffEnd = {"machine_file": sniffed.fragment, "problem": sniffed.problem}
    return json.dumps({**sniffed.figures, **end})


def _as_text(sniffed: Sniffed) -> str:
    parts = [part if isinstance(part, str) else _drawn(part) for part in sniffed.parts]
    if sniffed.fragment:
        parts.append(f"To begin a machine file with (daqsvc new asks for the rest):\n\n{sniffed.fragment}")
    return "\n\n".join(part.rstrip() for part in parts if part)


def _drawn(table: SniffTable) -> str:
    from daqsvc.commands.tables import aligned  # noqa: PLC0415 - each verb imports only what it needs

    return aligned(table.titles, table.rows)


def _tell(line: str) -> None:
    print(line, file=sys.stderr, flush=True)  # noqa: T201
