"""Has the page listen, until it is ended."""

from __future__ import annotations

import contextlib
import errno
import os
import signal
import socket
from typing import TYPE_CHECKING

import uvicorn

from daqsvc.page.server import application

if TYPE_CHECKING:
    from collections.abc import Iterator

    from starlette.applications import Starlette

    from daqsvc.page.sources import MachineSource

REMEDIES = {
    errno.EADDRINUSE: "end what listens there, or give another --port",
    errno.EACCES: "give a --port from 1024 on",
}
END_S = 1
"""How long browsers that listen are waited for at the end."""


class PortError(Exception):
    """The page cannot listen; the text says where, why and the remedy."""


class _Server(uvicorn.Server):
    """Ends at once: browsers listen for as long as they are let."""

    def __init__(self, config: uvicorn.Config, app: Starlette) -> None:
        super().__init__(config)
        self._app = app

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

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        """Let go of all browsers, and end."""
        await self._app.state.close()
        await super().shutdown(sockets)


def serve(source: MachineSource, what: str, host: str, port: int) -> None:
    """Serve the page of a service, or of snapshots, until SIGINT or SIGTERM; says where.

    Args:
        source: of what is shown.
        what: the same in words.
        host: where it listens.
        port: likewise; 0 for one that is free.

    Raises:
        PortError: it cannot listen there.
    """
    try:
        listening = socket.create_server((host, port), backlog=64)
    except OSError as error:
        remedy = REMEDIES.get(error.errno or 0, "give another --port")
        raise PortError(
            f"cannot listen at {host}:{port}: {os.strerror(error.errno or 0)}; {remedy}"
        ) from None
    with listening:
        where = f"http://{host}:{listening.getsockname()[1]}/"
        print(f"the page of {what} is at {where}; Ctrl-C ends it", flush=True)  # noqa: T201 - for a person
        app = application(source)
        config = uvicorn.Config(
            app,
            log_level="warning",
            access_log=False,
            server_header=False,
            timeout_graceful_shutdown=END_S,
        )
        _Server(config, app).run(sockets=[listening])
