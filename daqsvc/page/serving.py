"""Has the page listen, until it is ended."""

from __future__ import annotations

import contextlib
import errno
import os
import signal
import socket
from threading import Thread
from typing import TYPE_CHECKING

import uvicorn

from daqsvc.errors.command_line import CANNOT_LISTEN
from daqsvc.page.documentation import built_site
from daqsvc.page.server import application

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from starlette.applications import Starlette

    from daqsvc.page.access.choice import AccessChoice
    from daqsvc.page.sources import MachineSource

REMEDIES = {
    errno.EADDRINUSE: "end what listens there, or give another --port",
    errno.EACCES: "give a --port from 1024 on",
    errno.EADDRNOTAVAIL: "give an address of this machine as --listen",
}
OF_THE_FILE = {
    errno.EADDRINUSE: "end what listens there, or write another listen in [page]",
    errno.EACCES: "write a port from 1024 on as listen in [page]",
    errno.EADDRNOTAVAIL: "write an address of this machine as listen in [page]",
}
"""The same where a service starts the page: its machine file has the address, and nobody gives options."""
END_S = 1
"""How long browsers that listen are waited for at the end."""


class PortError(Exception):
    """The page cannot listen; the text states where, why and the remedy."""

    code = CANNOT_LISTEN


class PortInUseError(PortError):
    """Something listens there already."""


class _Server(uvicorn.Server):
    """Ends at once, as browsers listen for as long as they are let; states where it is when it answers."""

    def __init__(self, config: uvicorn.Config, app: Starlette, where: Sequence[str]) -> None:
        super().__init__(config)
        self._app = app
        self._where = where

    @contextlib.contextmanager
    def capture_signals(self) -> Iterator[None]:
        """End by a signal without being killed by it in the end."""
        numbers = (signal.SIGINT, signal.SIGTERM)
        before = {number: signal.signal(number, self.handle_exit) for number in numbers}
        try:
            yield
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Start to answer, and log it."""
        await super().startup(sockets)
        if self.started:
            for line in self._where:
                print(line, flush=True)  # noqa: T201 - for a person

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        """Release all browsers, and end."""
        await self._app.state.close()
        await super().shutdown(sockets)


def serve(
    source: MachineSource,
    what: str,
    port: int,
    choice: AccessChoice,
    *,
    with_parent: bool = False,
) -> None:
    """Serve the page of a service, or of snapshots, until SIGINT or SIGTERM; states where.

    Args:
        source: of what is shown.
        what: the same in words.
        port: where it listens; 0 for one that is free.
        choice: who may look, who may act, and the host where it listens.
        with_parent: whether a service has started it: it ends, too, when its standard input does.

    Raises:
        PortError: it cannot listen there.
        UnsafeError, AccountsError: it may not, as it was asked for.
    """
    choice.refuse_unsafe()
    choice.check_tls()
    access, key = choice.access()
    try:
        listening = _listening(choice.host, port)
    except OSError as error:
        remedies, otherwise = REMEDIES, "give another --listen"
        if with_parent:
            remedies, otherwise = OF_THE_FILE, "write another listen in [page]"
        remedy = remedies.get(error.errno or 0, otherwise)
        why = os.strerror(error.errno) if error.errno and error.errno > 0 else error.strerror or f"{error}"
        in_use = error.errno == errno.EADDRINUSE
        raise (PortInUseError if in_use else PortError)(
            f"cannot listen at {_bracketed(choice.host)}:{port}: {why}; {remedy}"
        ) from None
    with listening:
        tls = choice.certificate is not None
        port = listening.getsockname()[1]
        where = f"http{'s' if tls else ''}://{_bracketed(_name(choice))}:{port}/"
        # Ctrl-C would end the parent, not only the page.
        how_to_end = "" if with_parent else "; Ctrl-C ends it"
        lines = [f"the page of {what} is at {where}{how_to_end}"]
        if key:
            lines.append(f"who opens {where}operator?key={key} may handle alarms")
        hosts = (*choice.names, *(() if choice.is_local else (_bracketed(choice.host),)))
        app = application(source, access, hosts=hosts, tls=tls, documentation=built_site())
        config = uvicorn.Config(
            app,
            log_level="warning",
            access_log=False,
            server_header=False,
            proxy_headers=False,  # who is connected is what counts
            timeout_graceful_shutdown=END_S,
            ssl_certfile=choice.certificate,
            ssl_keyfile=choice.private_key,
        )
        if with_parent:
            Thread(target=_end_with_input, name="end with the parent", daemon=True).start()
        _Server(config, app, lines).run(sockets=[listening])


def _end_with_input() -> None:
    """End this process in order when its standard input ends: whoever holds the other end is gone."""
    while os.read(0, 4096):
        pass
    os.kill(os.getpid(), signal.SIGTERM)


def _listening(host: str, port: int) -> socket.socket:
    """A socket that listens.

    Raises:
        OSError: it cannot.
    """
    [(family, *_, address), *_] = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)
    return socket.create_server((address[0], port), family=family, backlog=64)


def _name(choice: AccessChoice) -> str:
    """What a person calls the host."""
    return choice.names[0] if choice.names and not choice.is_local else choice.host


def _bracketed(host: str) -> str:
    return f"[{host}]" if ":" in host else host
