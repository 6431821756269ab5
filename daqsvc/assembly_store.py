"""From a machine file to the limits of the outbox."""

from __future__ import annotations

from typing import TYPE_CHECKING

from daqsvc.acquisition.clock import NS_PER_S
from daqsvc.outbox.limits import MIB, NS_PER_DAY, OutboxLimits

if TYPE_CHECKING:
    from daqsvc.settings.models import MachineFile


def outbox_limits(machine: MachineFile) -> OutboxLimits:
    """How much the outbox may keep; what the machine file leaves out has the usual limits."""
    given = machine.store
    if given is None:
        return OutboxLimits()
    return OutboxLimits(
        alarms_max_bytes=given.alarms_max_mb * MIB,
        alarms_keep_ns=round(given.alarms_keep_days * NS_PER_DAY),
        telemetry_max_bytes=given.telemetry_max_mb * MIB,
        telemetry_max_age_ns=round(given.telemetry_max_age_s * NS_PER_S),
        reserve_bytes=given.reserve_mb * MIB,
        audit_max_bytes=given.audit_max_mb * MIB,
    )
