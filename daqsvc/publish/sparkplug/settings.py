"""The box as an edge node of Sparkplug B."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from daqsvc.publish.mqtt.settings import BrokerUrl  # noqa: TC001 - pydantic reads the annotations
from daqsvc.settings.section import ClientId, Name, Section


class Sparkplug(Section):
    """The edge node: alarms are its metrics, the machine is its device.

    Credentials and protocol are those of ``[mqtt]``.
    """

    group: Name | None = Field(
        default=None, description="Sparkplug group id; the site if absent", examples=["plant-1"]
    )
    edge_node: Name | None = Field(
        default=None, description="edge node id; the box if absent", examples=["edge-1"]
    )
    device: Name | None = Field(
        default=None, description="device id; the machine's name if absent", examples=["pump-2"]
    )
    client_id: ClientId | None = Field(
        default=None,
        description="MQTT client id; that of [mqtt] with :sparkplug if absent",
        examples=["edge-1-sparkplug"],
    )
    primary_host: Name | None = Field(
        default=None,
        description="host application to wait for; waits for nobody if absent",
        examples=["scada"],
    )
    servers: Annotated[tuple[BrokerUrl, ...], Field(strict=False, max_length=16)] = Field(
        default=(),
        description="brokers to try, one after another; that of [mqtt] if empty",
        examples=['["mqtts://broker-a.example:8883", "mqtts://broker-b.example:8883"]'],
    )
