"""What is made for several browsers at once: each picture of a view is made once, however many look at it."""

from __future__ import annotations

import asyncio
import base64
import contextlib
import json
import logging
import time
from typing import TYPE_CHECKING, Any

import numpy as np

from daqsvc.errors.code import coded
from daqsvc.errors.outputs import OUTPUT_FAILED
from daqsvc.page.findings import finding_rows
from daqsvc.page.present import value_rows
from daqsvc.page.text import alarm_list, alarm_rows, head, journal_rows, machine_rows

if TYPE_CHECKING:
    from collections.abc import AsyncGenerator, Mapping

    from daqsvc.page.machine_live import MachineLive
    from daqsvc.page.sources import Heard, MachineSource
    from daqsvc.page.views.view import MachineView

log = logging.getLogger(__name__)

HEAD_EVERY_S = 0.5
"""Longest time between two messages, so that a browser knows that the page is there."""
STALE_S = 3.0
"""Time without a line from the service after which the page shows it as silent."""


class Picture:
    """One view of one machine, made again and again while browsers look at it.

    Args:
        source: of the machines.
        machine: its name.
        view: what is shown beside the head; None for nothing.
        chosen: see `daqsvc.page.views.view.Choice`.
        as_a_whole: whether the tables of the machine as a whole are made, too.
    """

    def __init__(
        self,
        source: MachineSource,
        machine: str,
        view: MachineView | None,
        chosen: Mapping[str, str],
        *,
        as_a_whole: bool = False,
    ) -> None:
        self._source = source
        self._machine = machine
        self._view = view
        self._chosen = chosen
        self._as_a_whole = as_a_whole
        self._newest = b""
        self._made = asyncio.Condition()
        self._looking = 0
        self._is_over = False
        self._has_failed = False
        self._task: asyncio.Task[None] | None = None

    async def events(self) -> AsyncGenerator[bytes]:
        """Server-sent events, until the browser goes."""
        self._looking += 1
        if self._task is None:
            self._task = asyncio.create_task(self._make(), name=f"picture of {self._machine}")
        try:
            while not self._is_over:
                async with self._made:
                    await self._made.wait()
                    newest = self._newest
                yield newest
        finally:
            self._looking -= 1
            if not self._looking:
                self.end()

    @property
    def is_looked_at(self) -> bool:
        """Whether a browser looks at it."""
        return self._looking > 0

    async def close(self) -> None:
        """End it for all who look."""
        self._is_over = True
        self.end()
        async with self._made:
            self._made.notify_all()

    def end(self) -> None:
        """Make it no more."""
        if self._task is not None:
            self._task.cancel()
            self._task = None

    async def _make(self) -> None:
        async with self._source.looking(self._machine) as listening:
            with contextlib.ExitStack() as wanting:
                wanted: set[str] = set()
                every_s = HEAD_EVERY_S if self._view is None else self._view.every_s
                while True:
                    begun_s = time.monotonic()
                    streams = self._streams(listening)
                    if streams != wanted:
                        wanting.enter_context(listening.wanting(streams))
                        wanted = streams
                    content = await asyncio.to_thread(self._whatever, listening)
                    async with self._made:
                        self._newest = b"data: " + content + b"\n\n"
                        self._made.notify_all()
                    await asyncio.sleep(max(every_s - (time.monotonic() - begun_s), 0.01))

    def _streams(self, listening: Heard) -> set[str]:
        live = listening.live
        if self._view is None or live is None or self._view.why_not(live) or self._lacks(self._view, live):
            return set()
        return self._view.streams(live, self._chosen)

    def _lacks(self, view: MachineView, live: MachineLive) -> str:
        """What was chosen and is not there (any more), e.g. a sensor after a reload; else empty."""
        for choice in view.choices(live):
            if (chosen := self._chosen.get(choice.name, "nothing")) not in choice.options:
                return chosen
        return ""

    def _whatever(self, listening: Heard) -> bytes:
        """See `_encoded`; a mistake in this program is reported to browsers, too."""
        try:
            return self._encoded(listening)
        except Exception:
            if not self._has_failed:
                self._has_failed = True
                log.exception(
                    "the page cannot make %s of %s", self._view, self._machine, extra=coded(OUTPUT_FAILED)
                )
            return json.dumps(
                {"age_s": 0.0, "why": "the page has failed to make it: its log has the reason"}
            ).encode()

    def _encoded(self, listening: Heard) -> bytes:
        """What browsers get now, as JSON; on a thread."""
        live = listening.live
        silent_s = time.monotonic() - listening.heard_s
        why = listening.why_not or ("the service sends nothing" if silent_s > STALE_S else "")
        content: dict[str, Any] = {"age_s": round(silent_s, 1), "why": why}
        if live is not None:
            content["token"] = live.token
            stream, away_s = live.silence(self._streams(listening))
            if stream and not why:
                content |= {"age_s": round(away_s, 1), "why": f"nothing comes from {stream} any more"}
            content["html"] = {"head": head(live), "alarms": alarm_rows(live)}
            if self._as_a_whole:
                content["html"] |= {
                    "findings": finding_rows(live),
                    "values": value_rows(live),
                    "machine": machine_rows(live),
                    "journal": journal_rows(live),
                    "alarm-list": alarm_list(live.all_alarms(), self._machine),
                }
            if self._view is not None:
                content |= self._view_of(self._view, live)
        return json.dumps(content).encode()

    def _view_of(self, view: MachineView, live: MachineLive) -> dict[str, Any]:
        if why_not := view.why_not(live):
            return {"note": why_not}
        if lacking := self._lacks(view, live):
            return {"note": f"{lacking} is not there any more: choose another one, and press Show"}
        shown = view.shown(live, self._chosen)
        sources = {
            name: {column: _sent(values) for column, values in columns.items()}
            for name, columns in shown.sources.items()
        }
        taken_ns = live.newest_wall_ns(view.streams(live, self._chosen))
        return {
            "taken_ms": None if taken_ns is None else taken_ns / 1e6,
            "sources": sources,
            "rows": [list(row) for row in shown.rows],
            "note": shown.note,
        }


def _sent(values: Any) -> Any:
    """Numbers as the base64 of little-endian float32; texts as they are."""
    if isinstance(values, list):
        return values
    return {"f4": base64.b64encode(np.asarray(values, "<f4").tobytes()).decode()}
