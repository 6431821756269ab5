"""The alarm service of one machine."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from daqsvc.alarm_service import AlarmService
from daqsvc.alarms.handling import CALM
from daqsvc.alarms.manager import AlarmManager

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from daqsvc.acquisition.clock import Clock
    from daqsvc.alarms.events import Identity
    from daqsvc.alarms.rules import Rule
    from daqsvc.publish.output import OutputSet
    from daqsvc.settings.alarms import AlarmHandling


def alarm_service(
    identity: Identity,
    rules: Sequence[Rule],
    store: Path,
    clock: Clock,
    outputs: OutputSet | None = None,
    *,
    handling: AlarmHandling = CALM,
    **options: Any,
) -> AlarmService:
    """An alarm service with the alarms of ``rules``; ``options`` are its own."""
    return AlarmService(
        AlarmManager(identity, rules, clock, handling=handling), store, clock, outputs, **options
    )
