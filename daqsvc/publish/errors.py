"""What goes wrong between the box and a broker."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from paho.mqtt.reasoncodes import ReasonCode


class MqttError(Exception):
    """The broker refuses, or the connection to it is lost."""


class MqttCodeError(MqttError):
    """The broker, or the library, has given a code as the reason.

    Args:
        rc: a reason code of MQTT 5 (paho makes them of those of 3.1.1), or a number of the library's.
        text: what could not be done.
    """

    def __init__(self, rc: ReasonCode | int, text: str = "") -> None:
        super().__init__(f"{text}: {rc}" if text else str(rc))
        self.rc = rc


class NoConsentError(MqttError):
    """The broker was reached, but did not say whether it accepts the connection."""


class PublishRefusedError(MqttError):
    """The broker will not take one message; the connection stands."""


class SilentBrokerError(MqttError):
    """The connection stands, but no acknowledgement came over it in time."""


class TakenOverError(MqttError):
    """Another client has connected with the same client id."""
