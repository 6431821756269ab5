"""Metrics and health, kept up to date and served; whatever goes wrong with that ends nothing else."""

from __future__ import annotations

import asyncio
import errno
import time
from contextlib import suppress
from typing import TYPE_CHECKING, Any

from prometheus_client import CollectorRegistry, ProcessCollector
from prometheus_client.registry import Collector

from daqsvc.acquisition.clock import NS_PER_S
from daqsvc.acquisition.link import Backoff, Link
from daqsvc.outbox.messages import OutboxError
from daqsvc.publish.machine_figures import of_machine
from daqsvc.publish.metrics.families import (
    health_metric,
    machine_metrics,
    merged,
    reading_metrics,
    service_metrics,
)
from daqsvc.publish.metrics.server import MetricsServer
from daqsvc.publish.output import Output
from daqsvc.settings.addresses import address_of

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from prometheus_client.metrics_core import Metric

    from daqsvc.diagnosis.record import Diagnosis
    from daqsvc.publish.metrics.settings import Metrics
    from daqsvc.publish.output import OutputPort

LOOK_S = 1.0
STALLED_S = 10.0
"""A part with something to do that takes no step for so long is not healthy."""
END_S = 0.5
"""What the server's thread may take to end."""
OLDEST_S = 0.5
"""What asking the journal for its oldest event may take: its disk may hang."""
REMEDIES = {
    errno.EADDRINUSE: "end what listens there, or write another listen in [metrics]",
    errno.EADDRNOTAVAIL: "write an address of this machine as listen in [metrics]",
    errno.EACCES: "write a port from 1024 on as listen in [metrics]",
}


class MetricsOutput(Output, Collector):
    """Serves the metrics of the service, and whether it is healthy.

    Args:
        settings: the table.
        port: what it works with.
    """

    def __init__(self, settings: Metrics, port: OutputPort) -> None:
        address = address_of(settings.listen)
        assert address is not None  # noqa: S101 - the table is valid
        self._address = address
        self._port = port
        *_, self._own = port.machines
        self._link = Link(f"metrics at {settings.listen}")
        self._figures: Mapping[str, Any] | None = None
        self._oldest_age_s: float | None = None
        # All there will ever be: the threads that read it never see it grow.
        self._statements: dict[str, dict[str, tuple[Diagnosis, float] | None]] = {
            name: dict.fromkeys(sorted({*(r.detector for r in watched.readings), *watched.findings}))
            for name, watched in port.machines.items()
        }
        unhealthy = "/healthz answers that the service is not healthy"
        self._find_stalled = port.stalls.hold_to(STALLED_S, unhealthy)
        self._stalled: list[str] = []
        self._looked_s = time.monotonic()
        # What it collects depends on the machine files: a filter (name[]=) must ask it by its samples.
        self._registry = CollectorRegistry(support_collectors_without_names=True)
        self._registry.register(self)
        ProcessCollector(registry=self._registry)

    async def run(self) -> None:
        """Serve, and try again where that is impossible, until cancelled."""
        backoff = Backoff()
        looking = asyncio.create_task(self._look(), name="health")
        try:
            while True:
                try:
                    server = await self._listening()
                except OSError as error:
                    remedy = REMEDIES.get(error.errno or 0, "write another listen in [metrics]")
                    self._link.down(f"{error.strerror or error}: {remedy}")
                    self.reason, self.code = self._link.reason, self._link.code
                    await asyncio.sleep(backoff.next_ns() / NS_PER_S)
                    continue
                backoff.reset()
                self._link.up()
                self.reason = ""
                await self._serve(server, looking)
        finally:
            looking.cancel()
            self._link.stop()

    async def stop(self, deadline_s: float) -> None:
        """Nothing is left to hand over; see `Output.stop`."""

    def report(self, diagnosis: Diagnosis) -> None:
        """See `Output.report`."""
        statements = self._statements[diagnosis.machine]
        if diagnosis.detector in statements:
            statements[diagnosis.detector] = (diagnosis, time.time())

    def status(self, figures: Mapping[str, Any]) -> None:
        """See `Output.status`."""
        self._figures = figures

    def collect(self) -> Iterator[Metric]:
        """The metrics by now; on a thread of the server."""
        figures, machines = self._figures, self._port.machines.items()
        if figures is not None:
            yield from merged(
                metric
                for name, watched in machines
                for metric in machine_metrics(
                    name, of_machine(figures, name, watched.buses), watched.rates_hz
                )
            )
            yield from service_metrics(self._own, figures, self._oldest_age_s)
        yield from merged(
            metric
            for name, watched in machines
            for metric in reading_metrics(name, watched.readings, self._statements[name])
        )
        yield health_metric(self._own, is_healthy=not self.unhealthy())

    def describe(self) -> Iterator[Metric]:
        """Nothing: the registry need not know beforehand."""
        return iter(())

    def unhealthy(self) -> list[str]:
        """Why the service is not healthy, a sentence each; on any thread."""
        late_s = time.monotonic() - self._looked_s
        if late_s > STALLED_S:
            return [f"the event loop has been blocked for {late_s:.0f} s"]
        return [f"{part} has taken no step for {STALLED_S:g} s or more" for part in self._stalled]

    async def _listening(self) -> MetricsServer:
        """A server that listens.

        Raises:
            OSError: it cannot.
        """
        # On a thread: a name of a host may have to be asked for.
        made = asyncio.ensure_future(
            asyncio.to_thread(MetricsServer, self._address, self._registry, self.unhealthy)
        )
        try:
            return await asyncio.shield(made)
        except asyncio.CancelledError:
            await asyncio.wait({made})
            if made.exception() is None:
                made.result().server_close()
            raise

    async def _serve(self, server: MetricsServer, looking: asyncio.Task[None]) -> None:
        """Serve until cancelled, or until one of the two ends by itself.

        Raises:
            Exception: what it has ended with.
        """
        serving = asyncio.ensure_future(asyncio.to_thread(server.serve))
        try:
            await asyncio.wait({serving, looking}, return_when=asyncio.FIRST_COMPLETED)
            for ended in (serving, looking):
                if ended.done():
                    ended.result()
        finally:
            server.end()
            try:
                await asyncio.wait({serving}, timeout=END_S)
            finally:
                server.server_close()

    async def _look(self) -> None:
        while True:
            self._looked_s = time.monotonic()
            self._stalled = self._find_stalled(self._looked_s)
            self._oldest_age_s = await self._oldest()
            await asyncio.sleep(LOOK_S)

    async def _oldest(self) -> float | None:
        """Age of the oldest alarm event that waits for the broker; None if that is not known."""
        with suppress(TimeoutError, OutboxError):
            async with asyncio.timeout(OLDEST_S):
                begun_ns = await self._port.outbox.oldest_wall_ns()
            if begun_ns is not None:
                return max(self._port.clock.wall_ns() - begun_ns, 0) / NS_PER_S
        return None
