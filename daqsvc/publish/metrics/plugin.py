"""Metrics as a plugin."""

from __future__ import annotations

from typing import TYPE_CHECKING

from daqsvc.errors.outputs import OPEN_TO_NETWORK
from daqsvc.publish.metrics.settings import DEFAULT, Metrics
from daqsvc.publish.plugin import OutputPlugin
from daqsvc.settings.addresses import address_of
from daqsvc.settings.problems import Finding

if TYPE_CHECKING:
    from collections.abc import Iterator

    from daqsvc.publish.output import Output, OutputPort
    from daqsvc.settings.models import MachineFile


class MetricsPlugin(OutputPlugin[Metrics]):
    """Metrics for Prometheus, and whether the service is healthy."""

    settings = Metrics
    about = "metrics for Prometheus and a health endpoint; none are served if absent"
    place = 4
    label = "metrics"

    def checks(self, draft: MachineFile, settings: Metrics) -> Iterator[Iterator[Finding]]:
        """See `OutputTable.checks`."""
        del draft
        yield _open_to_the_network(settings)

    def describe(self, machine: MachineFile, settings: Metrics) -> str:
        """See `OutputTable.describe`."""
        del machine
        return f"http://{settings.listen}/metrics for Prometheus, /healthz"

    def build(self, machine: MachineFile, settings: Metrics, port: OutputPort) -> Output:
        """See `OutputPlugin.build`."""
        del machine
        from daqsvc.publish.metrics.output import MetricsOutput  # noqa: PLC0415 - the client library

        return MetricsOutput(settings, port)


def _open_to_the_network(settings: Metrics) -> Iterator[Finding]:
    address = address_of(settings.listen)
    if address is not None and not address.is_local:
        yield Finding(
            ("metrics", "listen"),
            "lets everybody in that network read the metrics: there is no password and no encryption",
            f'write listen = "{DEFAULT}" if Prometheus runs on this box, or let a firewall admit it alone',
            fatal=False,
            code=OPEN_TO_NETWORK,
        )
