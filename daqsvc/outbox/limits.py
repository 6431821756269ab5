"""How much the outbox may keep."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from daqsvc.acquisition.clock import NS_PER_S

if TYPE_CHECKING:
    from daqsvc.settings.store import Store

MIB = 1024 * 1024
NS_PER_DAY = 86_400 * NS_PER_S


@dataclass(frozen=True, slots=True, kw_only=True)
class OutboxLimits:
    """Bounds of the two classes of messages. Unsent alarms are bounded by the disk alone.

    No copy of the table ``[store]``: in bytes and ns, with bounds that no machine file sets, and there even
    without the table.

    Attributes:
        alarms_max_bytes: size of the alarms' file from which on the oldest messages that the broker has are
            deleted. The latest retained message of each topic, and what is not sent, is always kept.
        alarms_keep_ns: age by the wall clock from which on messages that the broker has are deleted.
        alarms_keep_at_least: so many of the newest messages are kept whatever their age, so that a wall
            clock that is wrong for a while does not cost the history.
        alarms_waiting_max: messages that may wait in memory while the disk cannot be written; further ones
            are refused, which is logged. One takes about 4 KiB, so that 16,384 of them take about 64 MiB.
        telemetry_max_bytes: size of the telemetry's file from which on the oldest messages are dropped.
        telemetry_max_age_ns: age from which on a telemetry message is dropped.
        reserve_bytes: free space that telemetry leaves on the disk to the alarms.
        ballast_bytes: room on the disk that is held for alarms on a full one (see `outbox.ballast`).
        audit_max_bytes: size of the audit log, with its older parts, from which on the oldest is deleted.
    """

    alarms_max_bytes: int = 256 * MIB
    alarms_keep_ns: int = 90 * NS_PER_DAY
    alarms_keep_at_least: int = 1000
    alarms_waiting_max: int = 16_384
    telemetry_max_bytes: int = 64 * MIB
    telemetry_max_age_ns: int = NS_PER_DAY
    reserve_bytes: int = 64 * MIB
    ballast_bytes: int = 16 * MIB
    audit_max_bytes: int = 32 * MIB

    @classmethod
    def of(cls, store: Store | None) -> OutboxLimits:
        """As the machine file states; what it leaves out has the usual limits."""
        if store is None:
            return cls()
        return cls(
            alarms_max_bytes=store.alarms_max_mb * MIB,
            alarms_keep_ns=round(store.alarms_keep_days * NS_PER_DAY),
            telemetry_max_bytes=store.telemetry_max_mb * MIB,
            telemetry_max_age_ns=round(store.telemetry_max_age_s * NS_PER_S),
            reserve_bytes=store.reserve_mb * MIB,
            audit_max_bytes=store.audit_max_mb * MIB,
        )
