"""The page as a plugin."""

from __future__ import annotations

from typing import TYPE_CHECKING

from daqsvc.errors.machine_file import CONTRADICTION, INCOMPLETE
from daqsvc.errors.outputs import HOST_NAMES, OPEN_TO_NETWORK
from daqsvc.publish.page.settings import DEFAULT, Page
from daqsvc.publish.plugin import OutputPlugin
from daqsvc.settings.addresses import address_of, is_everywhere
from daqsvc.settings.problems import Finding

if TYPE_CHECKING:
    from collections.abc import Iterator

    from daqsvc.publish.output import Output, OutputPort
    from daqsvc.settings.models import MachineFile


class PagePlugin(OutputPlugin[Page]):
    """The page in a browser, as a separate process that the service starts."""

    settings = Page
    about = "the page in a browser; the service starts none if absent"
    place = 6
    label = "page"
    status_key = "page"

    def checks(self, draft: MachineFile, settings: Page) -> Iterator[Iterator[Finding]]:
        """See `OutputTable.checks`."""
        del draft
        yield _pairs(settings)
        yield _open_to_the_network(settings)

    def describe(self, machine: MachineFile, settings: Page) -> str:
        """See `OutputTable.describe`."""
        del machine
        scheme = "http" if settings.certificate_file is None else "https"
        return f"{scheme}://{settings.listen}/, {_who(settings)}"

    def build(self, machine: MachineFile, settings: Page, port: OutputPort) -> Output:
        """See `OutputPlugin.build`."""
        from daqsvc.publish.page.output import PageOutput  # noqa: PLC0415 - only what runs needs it

        return PageOutput(_arguments(machine, settings), settings.listen, port.store)


def _who(settings: Page) -> str:
    if settings.accounts_file is not None:
        return f"for who signs in with an account of {settings.accounts_file}"
    if settings.user_header is not None:
        return f"for whom a reverse proxy names in {settings.user_header}"
    return "for who is on this box, to look only"


def _arguments(machine: MachineFile, settings: Page) -> list[str]:
    """The arguments of `daqsvc page`."""
    arguments = [f"--listen={settings.listen}"]
    files = {
        "certificate": settings.certificate_file,
        "private-key": settings.private_key_file,
        "accounts": settings.accounts_file,
    }
    arguments += [f"--{name}={machine.resolve(file)}" for name, file in files.items() if file is not None]
    if settings.user_header is not None:
        arguments.append(f"--user-header={settings.user_header}")
    lists = {"host-name": settings.host_names, "proxy": settings.proxies, "operator": settings.operators}
    arguments += [f"--{name}={one}" for name, ones in lists.items() for one in ones]
    return arguments


def _pairs(settings: Page) -> Iterator[Finding]:
    """What belongs together is there together."""
    for one, other in (
        ("certificate_file", "private_key_file"),
        ("private_key_file", "certificate_file"),
        ("user_header", "proxies"),
        ("proxies", "user_header"),
        ("operators", "user_header"),
    ):
        if getattr(settings, one) and not getattr(settings, other):
            yield Finding(
                ("page", one),
                f"is of no use without {other}",
                f"write {other}, or remove {one}",
                code=INCOMPLETE,
            )
    if settings.accounts_file is not None and settings.user_header is not None:
        yield Finding(
            ("page", "accounts_file"),
            "is given besides user_header, and only one can name who asks",
            "remove one of them",
            code=CONTRADICTION,
        )


def _open_to_the_network(settings: Page) -> Iterator[Finding]:
    address = address_of(settings.listen)
    if address is not None and is_everywhere(address.host) and not settings.host_names:
        yield Finding(
            ("page", "listen"),
            "is every address of the box, and it is not known by which names the page is opened",
            'write host_names = ["..."] with each, also if it is an address of the box',
            code=HOST_NAMES,
        )
    if address is None or address.is_local or settings.user_header is not None:
        return
    if settings.accounts_file is None or settings.certificate_file is None:
        yield Finding(
            ("page", "listen"),
            "lets others than this box reach the page, which needs TLS and accounts then",
            "write certificate_file, private_key_file and accounts_file; or user_header and proxies, behind "
            f'a reverse proxy; or listen = "{DEFAULT}"',
            code=OPEN_TO_NETWORK,
        )
