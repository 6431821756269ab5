"""What the outbox has done, for the status that the service publishes."""

from __future__ import annotations

from dataclasses import dataclass, field


@dataclass(slots=True)
class TelemetryCounters:
    """What became of telemetry since the outbox was opened.

    Attributes:
        accepted: messages taken in.
        sent: messages that the broker has taken.
        depth: messages kept for the broker.
        dropped_full: the oldest ones, dropped because the limit in bytes was reached.
        dropped_old: messages dropped because they were too old.
        dropped_disk: messages that a nearly full disk or a broken file cost, as far as they could be counted.
        write_errors: transactions that failed.
        quarantined: corrupt files set aside.
        restarts: how often the thread that keeps telemetry has begun again after its own failure.
        in_memory: 1 while the file cannot be used and telemetry is kept in memory, else 0.
    """

    accepted: int = 0
    sent: int = 0
    depth: int = 0
    dropped_full: int = 0
    dropped_old: int = 0
    dropped_disk: int = 0
    write_errors: int = 0
    quarantined: int = 0
    restarts: int = 0
    in_memory: int = 0

    @property
    def dropped(self) -> int:
        """Messages dropped for whatever reason."""
        return self.dropped_full + self.dropped_old + self.dropped_disk


@dataclass(slots=True)
class OutboxCounters:
    """What the outbox has done since it was opened.

    Attributes:
        appended: messages committed.
        sent: messages that the broker has acknowledged.
        depth: messages on disk that the broker has not acknowledged.
        waiting: messages in memory that are not on disk yet.
        write_errors: transactions that failed and were tried again.
        read_errors: reads that failed and were tried again.
        quarantined: corrupt files set aside.
        vanished: messages on disk, at least, which the file no longer knew when it was opened: it was
            damaged, deleted, or is an older copy.
        refused: messages refused because too many waited in memory for a disk that cannot be written.
        lost: messages that reached neither the disk nor the broker because the outbox was closed while it
            could not write.
        shut: 1 until the journal can be opened, else 0.
        unbacked: 1 while the disk takes no messages and those that come go to the broker from memory, else 0.
        sent_unbacked: messages that the broker has acknowledged before the disk had them; they are journalled
            as soon as that takes writes again.
        unjournalled: of these, messages that the journal will never have: there were too many, or the service
            was stopped before the disk took writes again.
        telemetry: what became of telemetry.
    """

    appended: int = 0
    sent: int = 0
    depth: int = 0
    waiting: int = 0
    write_errors: int = 0
    read_errors: int = 0
    quarantined: int = 0
    vanished: int = 0
    refused: int = 0
    lost: int = 0
    shut: int = 0
    unbacked: int = 0
    sent_unbacked: int = 0
    unjournalled: int = 0
    telemetry: TelemetryCounters = field(default_factory=TelemetryCounters)
