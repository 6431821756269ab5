"""What the box is to Sparkplug, and where."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from pathlib import Path

    from daqsvc.diagnosis.reading import Reading


class Server(NamedTuple):
    """A broker that the edge node may connect to.

    Attributes:
        host: host name or address.
        port: TCP port.
        tls: whether to use TLS.
    """

    host: str
    port: int
    tls: bool


@dataclass(frozen=True, slots=True)
class SparkplugSettings:
    """The edge node.

    Attributes:
        group: Sparkplug group id.
        edge_node: edge node id.
        device: id of the device that the machine is.
        machine: name of the machine, by which its alarms are known.
        servers: brokers in the order of preference, one connection at a time.
        client_id: MQTT client id, another than that of the box's own topics.
        primary_host: host application to wait for; None waits for nobody.
        alarms: names of the machine's alarms, known before any of them is raised.
        readings: figures of the detectors that are metrics of the device.
        memory: file for what must survive a restart.
    """

    group: str
    edge_node: str
    device: str
    machine: str
    servers: tuple[Server, ...]
    client_id: str
    memory: Path
    primary_host: str | None = None
    alarms: tuple[str, ...] = ()
    readings: tuple[Reading, ...] = ()
