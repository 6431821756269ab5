"""What the publisher has done, for the status that it publishes."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(slots=True)
class PublishCounters:
    """What the publisher has done.

    Attributes:
        connected: whether there is a connection now.
        connections: how many there have been.
        published: alarm messages handed to the broker, repeats included.
        acknowledged: alarm messages for which a PUBACK came.
        telemetry_sent: telemetry messages for which a PUBACK came.
        telemetry_refused: telemetry messages that the broker would not take.
        refused: alarm messages that the broker would not take, repeats included; they are kept.
        overlooked: messages from the broker dropped because too many came at a time.
        ignored: messages from the broker that the box has not subscribed to, or that came before its consent.
        faults: mistakes of this program, each of which the log names once.
    """

    connected: bool = False
    connections: int = 0
    published: int = 0
    acknowledged: int = 0
    telemetry_sent: int = 0
    telemetry_refused: int = 0
    refused: int = 0
    overlooked: int = 0
    ignored: int = 0
    faults: int = 0

    def count_published(self) -> None:
        """One more was handed to the broker."""
        self.published += 1

    def count_telemetry_sent(self) -> None:
        """One more telemetry message was acknowledged."""
        self.telemetry_sent += 1

    def count_telemetry_refused(self) -> None:
        """One more telemetry message was refused."""
        self.telemetry_refused += 1

    def count_overlooked(self) -> None:
        """One more message from the broker was dropped."""
        self.overlooked += 1

    def count_ignored(self) -> None:
        """One more message from the broker was none of the box's."""
        self.ignored += 1
