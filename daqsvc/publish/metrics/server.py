"""The HTTP server of metrics and health: a few short requests at a time, on threads of its own.

It answers also while the event loop stands still, and whatever a client does costs a thread for some seconds.
"""

from __future__ import annotations

import contextlib
import io
import logging
import math
import socket
import sys
import threading
import time
from http import HTTPStatus
from http.server import ThreadingHTTPServer
from socketserver import TCPServer
from typing import TYPE_CHECKING, Any

from prometheus_client import MetricsHandler

from daqsvc.acquisition.link import LoggedOnce
from daqsvc.errors.code import coded
from daqsvc.errors.outputs import OUTPUT_FAILED

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from prometheus_client.registry import Collector

    from daqsvc.settings.addresses import Address

log = logging.getLogger(__name__)

MOST_CLIENTS = 16
PATIENCE_S = 5.0
"""What a request and its answer may take together."""
LOOK_S = 0.1


class MetricsServer(ThreadingHTTPServer):
    """Serves ``/metrics`` and ``/healthz``.

    Args:
        address: where to listen.
        registry: the metrics.
        unhealthy: states why the service is not healthy; nothing if it is.

    Raises:
        OSError: it is not possible to listen there.
    """

    daemon_threads = True
    block_on_close = False
    request_queue_size = MOST_CLIENTS
    timeout = LOOK_S

    def __init__(self, address: Address, registry: Collector, unhealthy: Callable[[], Sequence[str]]) -> None:
        if ":" in address.host:
            self.address_family = socket.AF_INET6
        self._until_s: dict[socket.socket, float] = {}
        self._lock = threading.Lock()
        self._logged = LoggedOnce()
        self._ended = False
        super().__init__((address.host, address.port), _handler(registry, unhealthy))

    def server_bind(self) -> None:
        """Like that of the base class, without asking the network for the name of the host."""
        TCPServer.server_bind(self)
        self.server_name, self.server_port = str(self.server_address[0]), int(self.server_address[1])

    def serve(self) -> None:
        """Serve until `end`; blocks."""
        # Not `serve_forever`: whoever asks that to end waits for ever if its thread is lost.
        while not self._ended:
            self.handle_request()
            self._cut_off(time.monotonic())

    def end(self) -> None:
        """Have `serve` end within `LOOK_S`, and the requests that are being answered now."""
        self._ended = True
        self._cut_off(math.inf)

    def verify_request(self, request: Any, client_address: Any) -> bool:
        """Whether there is room for one more client."""
        del client_address
        with self._lock:
            if len(self._until_s) >= MOST_CLIENTS:
                return False
            self._until_s[request] = time.monotonic() + PATIENCE_S
        return True

    def shutdown_request(self, request: Any) -> None:
        """See the base class."""
        with self._lock:
            self._until_s.pop(request, None)
        super().shutdown_request(request)

    def _cut_off(self, now_s: float) -> None:
        """End the connections of who takes too long."""
        with self._lock:
            late = [client for client, until_s in self._until_s.items() if until_s < now_s]
        for client in late:
            with contextlib.suppress(OSError):  # it has gone already
                client.shutdown(socket.SHUT_RDWR)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Say a mistake of ours once an hour; that clients go away is none."""
        del request, client_address
        error = sys.exc_info()[1]
        if isinstance(error, OSError) or error is None:
            return
        if self._logged.may_say(f"{error!r}"):
            log.error(
                "metrics: a request has failed: %r; the others are answered",
                error,
                extra=coded(OUTPUT_FAILED),
            )


def _handler(registry: Collector, unhealthy: Callable[[], Sequence[str]]) -> type[MetricsHandler]:
    class Handler(MetricsHandler):
        timeout = PATIENCE_S

        def do_GET(self) -> None:  # noqa: N802 - the name that the base class has given it
            path = self.path.partition("?")[0]
            if path == "/metrics":
                super().do_GET()
            elif path == "/healthz":
                self._tell_health()
            else:
                self.send_error(HTTPStatus.NOT_FOUND, explain="there are /metrics and /healthz")

        def do_HEAD(self) -> None:  # noqa: N802 - as above
            self.do_GET()

        def end_headers(self) -> None:
            """See the base class; to who asks with HEAD nothing more is sent."""
            super().end_headers()
            if self.command == "HEAD":
                self.wfile = io.BytesIO()

        def _tell_health(self) -> None:
            reasons = unhealthy()
            body = "".join(f"{reason}\n" for reason in reasons or ("ok",)).encode("utf-8", "replace")
            self.send_response(HTTPStatus.SERVICE_UNAVAILABLE if reasons else HTTPStatus.OK)
            self.send_header("Content-Type", "text/plain; charset=utf-8")
            self.send_header("Content-Length", f"{len(body)}")
            self.end_headers()
            self.wfile.write(body)

    Handler.registry = registry
    return Handler
