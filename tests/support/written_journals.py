"""Journals with alarm messages in them, without the service that would have written them."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

from daqsvc.acquisition.clock import SystemClock
from daqsvc.outbox.store import Outbox

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path


def _payload(sequence: int, **keys: Any) -> bytes:
    told = {
        "schema": "daqsvc.alarm/1",
        "id": f"edge-1-{sequence}",
        "sequence": sequence,
        "machine": "motor",
        "alarm": "shaking",
        "occurrence": "0d8c1c4e-6f3a-4a55-9a53-5b0e8c1f7a21",
        "kind": "raised",
        "state": "active_unacknowledged",
        "level": "alert",
        "wall_ns": 1_795_264_095_376_165_000,
        "message": "shaking alert: rms of accel is 0.98 g",
    }
    return json.dumps(told | keys).encode()


async def write_journal(store: Path, *events: dict[str, Any]) -> None:
    """Write alarm messages into a journal, and one of another kind.

    Args:
        store: its directory.
        events: each by what differs from an alarm of the machine ``motor``.
    """
    outbox = Outbox(store / "outbox.sqlite", SystemClock())
    await outbox.open()

    def of(keys: dict[str, Any]) -> Callable[[int], bytes]:
        return lambda sequence: _payload(sequence, **keys)

    for keys in events:
        topic = f"daqsvc/lab/edge-1/{keys.get('machine', 'motor')}/alarms/{keys.get('alarm', 'shaking')}"
        await outbox.append(topic, of(keys), retain=True)
    await outbox.append("daqsvc/lab/edge-1/other", lambda _: b'{"schema": "other/1"}', retain=True)
    await outbox.close()
