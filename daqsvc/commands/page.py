"""``daqsvc page``: the machines of this box, those of a plant, or snapshots, in a browser."""

from __future__ import annotations

import argparse
import ipaddress
from pathlib import Path
from typing import TYPE_CHECKING

from daqsvc.commands.arguments import EXIT_OK, EXIT_REFUSED, EXIT_USAGE
from daqsvc.commands.complaint import complain
from daqsvc.commands.store_argument import BadFileError, StoreNotFoundError, add_store, chosen_store
from daqsvc.documentation import documented_in
from daqsvc.errors.command_line import EXTRA_MISSING
from daqsvc.settings.addresses import MOST_PORT, Address, address_of

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from daqsvc.commands.machine_files import Load
    from daqsvc.page.access.choice import AccessChoice
    from daqsvc.page.recorded import SnapshotSource

PORT = 8420
LOOPBACK = "127.0.0.1"


class PageCommand:
    """``daqsvc page [FILE | --store DIR | --plant FILE | --snapshot FILE...]``.

    Args:
        load: reads a machine file; None after its errors have been printed.
        start_logging: of the command line.
    """

    help = "show the machines of this box in a browser"
    description = (
        "Show the machines that the service on this box watches in a web page: their state, what is "
        "wrong with them and how sure that is; orbit, waveform and spectra. The page is a separate "
        "process, and the service does not wait for it. Only this box can open it, unless options below "
        "open it to others. Needs the extra 'page'."
    )

    def __init__(self, load: Load, start_logging: Callable[..., None]) -> None:
        self._load = load
        self._start_logging = start_logging

    def add_arguments(self, parser: argparse.ArgumentParser) -> None:
        """See `daqsvc.cli.Command.add_arguments`."""
        self._parser = parser
        parser.add_argument(
            "--snapshot",
            type=Path,
            action="append",
            metavar="FILE",
            help="show a snapshot of the recorder instead of a service, played in a loop; may be repeated, "
            "e.g. to compare it with a healthy one",
        )
        parser.add_argument(
            "--plant",
            type=Path,
            metavar="FILE",
            help="show all boxes that publish to a broker instead of the service on this box; FILE has a "
            "table [mqtt], as in a machine file",
        )
        where = parser.add_mutually_exclusive_group()
        where.add_argument("--port", type=_port, help=f"TCP port on {LOOPBACK} (default: {PORT})")
        where.add_argument(
            "--listen",
            type=_listen,
            metavar="HOST:PORT",
            help="address to listen at; beyond this box it needs TLS and accounts, or a reverse proxy",
        )
        # For a program that starts the page: it ends with that program, however that ends.
        parser.add_argument("--with-parent", action="store_true", help=argparse.SUPPRESS)
        _add_access(
            parser.add_argument_group(
                f"who may see the page, and who may handle alarms ({documented_in('page')})"
            )
        )
        add_store(parser, of_a_machine=False)

    def run(self, arguments: argparse.Namespace) -> int:
        """See `daqsvc.cli.Command.run`."""
        if arguments.snapshot is not None and (arguments.file or arguments.store):
            self._parser.error("--snapshot shows no service: leave the machine file and --store out")
        if arguments.plant is not None and (arguments.file or arguments.store or arguments.snapshot):
            self._parser.error(
                "--plant shows the messages of a broker: leave out what names a box or a snapshot"
            )
        try:
            from daqsvc.page.access.accounts import AccountsError  # noqa: PLC0415 - an extra
            from daqsvc.page.access.choice import UnsafeError  # noqa: PLC0415
            from daqsvc.page.plant.plant_file import PlantFileError, read_plant_file  # noqa: PLC0415
            from daqsvc.page.plant.source import PlantSource  # noqa: PLC0415
            from daqsvc.page.recorded import NoPictureError  # noqa: PLC0415
            from daqsvc.page.serving import PortError, serve  # noqa: PLC0415
            from daqsvc.snapshots.reading import SnapshotError  # noqa: PLC0415
        except ModuleNotFoundError as error:
            what = f"{error.name} is missing: install it with pip install 'daqsvc[page]'"
            return complain("daqsvc page", what, EXTRA_MISSING)
        self._start_logging(verbose=False)
        listen = arguments.listen or Address(LOOPBACK, PORT if arguments.port is None else arguments.port)
        try:
            choice, with_parent = _access_choice(arguments, listen.host), arguments.with_parent
            if arguments.snapshot is not None:
                serve(
                    _of_snapshots(arguments.snapshot),
                    "snapshots",
                    listen.port,
                    choice,
                    with_parent=arguments.with_parent,
                )
            elif arguments.plant is not None:
                mqtt = read_plant_file(arguments.plant)
                serve(PlantSource(mqtt), "the plant", listen.port, choice, with_parent=with_parent)
            else:
                store = self._store(arguments)
                _serve_box(store, listen, choice, with_parent=with_parent)
        except BadFileError:
            return EXIT_USAGE
        except (UnsafeError, PlantFileError) as error:
            return complain("daqsvc page", error, error.code, EXIT_USAGE)
        except (StoreNotFoundError, PortError, AccountsError) as error:
            return complain("daqsvc page", error, error.code)
        except (SnapshotError, NoPictureError) as error:
            return complain("daqsvc page", error, error.code, EXIT_REFUSED)
        return EXIT_OK

    def _store(self, arguments: argparse.Namespace) -> Path:
        """The store of the service.

        Raises:
            BadFileError: the machine file has errors, which were printed.
            StoreNotFoundError: there is none.
        """
        chosen = chosen_store(arguments, self._load)
        chosen.tell_other("daqsvc page")
        store = chosen.directory
        if not store.is_dir():
            raise StoreNotFoundError(
                f"the store {store} does not exist: name that of a service by --store, or start "
                "the service first"
            )
        return store


def _serve_box(store: Path, listen: Address, choice: AccessChoice, *, with_parent: bool) -> None:
    """Serve the page of the service on a store.

    Raises:
        PortError: it cannot listen there.
    """
    from daqsvc.page.serving import PortError, PortInUseError, serve  # noqa: PLC0415 - an extra
    from daqsvc.page.source import BoxSource  # noqa: PLC0415

    try:
        serve(BoxSource(store), f"{store}", listen.port, choice, with_parent=with_parent)
    except PortInUseError:
        if with_parent or not _shows_its_page(store):
            raise
        raise PortError(
            f"{listen.host}:{listen.port} is in use, and the service on {store} shows its page itself "
            "([page] of its machine file): open that address in a browser, or give another --port"
        ) from None


def _shows_its_page(store: Path) -> bool:
    """Whether the service that runs on a store has its own page."""
    from daqsvc.control import ControlError, ask_status  # noqa: PLC0415 - only what a verb needs

    try:
        return any("page" in status["outputs"] for status in ask_status(store))
    except ControlError:
        return False


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


def _add_access(group: argparse._ArgumentGroup) -> None:
    group.add_argument(
        "--operator-link",
        action="store_true",
        help="print an address, a new one at each start; whoever opens it on this box may handle alarms",
    )
    group.add_argument(
        "--accounts",
        type=Path,
        metavar="FILE",
        help="accounts to sign in with, from daqsvc account",
    )
    group.add_argument("--certificate", type=Path, metavar="FILE", help="TLS certificate of the page (PEM)")
    group.add_argument(
        "--private-key", type=Path, metavar="FILE", help="private key of that certificate (PEM)"
    )
    group.add_argument(
        "--host-name",
        action="append",
        default=[],
        metavar="NAME",
        help="host name under which other computers open the page; may be repeated",
    )
    group.add_argument(
        "--user-header",
        default="",
        metavar="NAME",
        help="HTTP header in which a reverse proxy names the user",
    )
    group.add_argument(
        "--proxy",
        action="append",
        default=[],
        type=_address,
        metavar="ADDRESS",
        help="IP address of that proxy; may be repeated",
    )
    group.add_argument(
        "--operator",
        action="append",
        default=[],
        metavar="USER",
        help="user of that proxy who may handle alarms; may be repeated",
    )


def _access_choice(arguments: argparse.Namespace, host: str) -> AccessChoice:
    from daqsvc.page.access.choice import AccessChoice  # noqa: PLC0415 - an extra

    return AccessChoice(
        host=host,
        names=tuple(arguments.host_name),
        certificate=arguments.certificate,
        private_key=arguments.private_key,
        accounts=arguments.accounts,
        user_header=arguments.user_header,
        proxies=tuple(arguments.proxy),
        operators=tuple(arguments.operator),
        operator_link=arguments.operator_link,
    )


def _listen(text: str) -> Address:
    address = address_of(text)
    if address is None:
        raise argparse.ArgumentTypeError(
            f"{text!r} is no address to listen at: give a host and a port, e.g. 127.0.0.1:8420 or [::1]:8420"
        )
    return address


def _address(text: str) -> str:
    try:
        return f"{ipaddress.ip_address(text)}"
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is no IP address, such as 127.0.0.1") from None


def _port(text: str) -> int:
    if text.isascii() and text.isdecimal() and int(text) <= MOST_PORT:
        return int(text)
    raise argparse.ArgumentTypeError(f"{text!r} is no port: give a number from 0 to {MOST_PORT}")
