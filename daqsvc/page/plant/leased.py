"""Listening to a machine over the broker: its box is asked again and again while somebody looks."""

from __future__ import annotations

import asyncio
import contextlib
import json
import math
import time
from typing import TYPE_CHECKING, Any

from daqsvc.page.listening import Listening
from daqsvc.page.plant.link import BrokerAwayError
from daqsvc.publish.live.pieces import BrokenFeedError, Unpacker

if TYPE_CHECKING:
    from collections.abc import Iterator

    from daqsvc.acquisition.link import Backoff
    from daqsvc.page.plant.known import KnownBox, KnownMachine
    from daqsvc.page.plant.link import BrokerLink

    Document = dict[str, Any]

LEASE_S = 15.0
ASK_EVERY_S = 5.0
"""Three requests may be lost before a feed ends that is wanted."""
LONGEST_LINE = 64 * 1024 * 1024
LOOK_S = 1.0
PATIENCE_S = 2.0
"""After so long without an answer it is shown what the box publishes for all, until there is one."""
SILENT_S = 10.0
"""A feed that has sent nothing for so long is asked for again; it states each second that it is alive."""
NO_WAVEFORMS = (
    "This box sends alarms and diagnoses but no waveforms: add [mqtt.live] to its machine file, and allow "
    "this page to publish below live/ at the broker."
)


class LeasedListening(Listening):
    """Listens to one machine of a plant.

    Args:
        link: to the broker.
        box: the machine's.
        machine: what is known of it.
    """

    def __init__(self, link: BrokerLink, box: KnownBox, machine: KnownMachine) -> None:
        super().__init__(machine.name, None)
        self._link = link
        self._box = box
        self._known = machine
        self._topics = link.topics_of(machine)
        self._refused_s = math.inf
        """When the box has refused to send waveforms: it is asked again after a while."""
        self._hears_over: int | None = None
        """Over which connection diagnoses come that the box publishes for all; None if none do."""

    async def listen(self, backoff: Backoff) -> None:
        """See `Listening.listen`."""
        while away := self._link.why_not or self._box.away:
            self._show_known()
            self.why_not = away
            await asyncio.sleep(LOOK_S)
        feed = time.time_ns() // 1_000_000
        name = self._known.machine
        request = self._topics.live_request(name, self._link.looker)
        with self._link.feed(self._topics.live_feed(name, self._link.looker)) as pieces, self._telling():
            asking = asyncio.create_task(self._ask(request, feed), name=f"ask {self.machine}")
            waiting = asyncio.create_task(self.anew.wait(), name="other streams are wanted")
            try:
                await self._hear(Unpacker(feed), pieces, {asking, waiting}, backoff)
            finally:
                if not self.anew.is_set():
                    self._link.tell(request, self._request(feed, 0.0))
                for task in (asking, waiting):
                    task.cancel()
                await asyncio.wait({asking, waiting})
                await self._leave_diagnoses()

    async def _hear(
        self,
        unpacker: Unpacker,
        pieces: asyncio.Queue[bytes],
        ends: set[asyncio.Task[Any]],
        backoff: Backoff,
    ) -> None:
        """Take the pieces of a feed until it ends; where there is none, what the broker tells all."""
        rest, heard_s = b"", time.monotonic()
        self._refused_s = math.inf
        while not any(task.done() for task in ends) and time.monotonic() < self._refused_s + LEASE_S:
            piece = await _next(pieces, ends)
            if piece is None:
                self._bear_silence(time.monotonic() - heard_s)
            else:
                took = unpacker.take(piece)
                heard_s = time.monotonic() if took else heard_s
                *lines, rest = (rest + took).split(b"\n")
                if len(rest) > LONGEST_LINE:
                    raise BrokenFeedError("a line of the feed has no end")
                for line in lines:
                    self._take_line(json.loads(line))
                    backoff.reset()
            await self._follow_diagnoses()
        for task in ends:
            if task.done() and not task.cancelled():
                task.result()

    async def _follow_diagnoses(self) -> None:
        """Have the diagnoses come that the box publishes for all, where they are all there is; else not."""
        if not self._is_poor:
            await self._leave_diagnoses()
            return
        if self._hears_over != self._link.connections:
            self._hears_over = self._link.connections
            await self._link.hear_diagnoses(self._known)
        if self._box.heard_s is not None:
            self.heard_s = self._box.heard_s

    async def _leave_diagnoses(self) -> None:
        if self._hears_over == self._link.connections:
            await self._link.leave_diagnoses(self._known)
        self._hears_over = None

    def _bear_silence(self, silent_s: float) -> None:
        """Show what there is while nothing comes of the feed.

        Raises:
            ConnectionError: it has to be asked for again.
        """
        if away := self._link.why_not or self._box.away:
            raise ConnectionError(away)
        if silent_s > SILENT_S and not self._is_poor:
            raise ConnectionError("the box sends nothing any more")
        if silent_s > PATIENCE_S:
            self._show_known()

    @property
    def _is_poor(self) -> bool:
        """Whether what is shown is only what the box publishes for all."""
        return self.live is not None and bool(self.live.note)

    def _take_line(self, line: Document) -> None:
        if line.get("accepted") is False:
            self._refused(str(line.get("reason", "it does not state why")))
        elif "schema" in line:
            line.pop("folder", None)  # no box states which files are opened here
            self.begin(line)
        elif line.get("over"):
            raise ConnectionError("the service begins again")
        else:
            self.take(line)

    def _refused(self, why: str) -> None:
        """Show what the box publishes for everybody, as it refuses to send more to this page."""
        if self.live is not None and not self._is_poor:
            raise ConnectionError(why)
        self._refused_s = time.monotonic()
        self._show_known()
        if self.live is not None:
            self.live.note = f"This box sends no waveforms: {why}."

    def _show_known(self) -> None:
        """Begin with what the box publishes for all, unless that or more is shown already."""
        if self.live is None:
            self.begin(self._known.about())
            if self.live is not None:
                self.live.note = NO_WAVEFORMS

    @contextlib.contextmanager
    def _telling(self) -> Iterator[None]:
        """Take meanwhile what the box publishes for all."""
        self._known.hearing.append(self._hear_known)
        try:
            yield
        finally:
            self._known.hearing.remove(self._hear_known)

    def _hear_known(self, line: Document) -> None:
        if self._is_poor:
            self.take(line)

    async def _ask(self, request: str, feed: int) -> None:
        while True:
            try:
                await self._link.say(request, self._request(feed, LEASE_S))
            except BrokerAwayError:
                if self._link.why_not:
                    raise
                # The broker lets this page not ask: what it lets it hear is shown all the same.
            await asyncio.sleep(ASK_EVERY_S)

    def _request(self, feed: int, lease_s: float) -> bytes:
        asked = {
            "schema": "daqsvc.live-request/1",
            "feed": feed,
            "streams": sorted(self.streams),
            "lease_s": lease_s,
        }
        return json.dumps(asked).encode()


async def _next(pieces: asyncio.Queue[bytes], ends: set[asyncio.Task[Any]]) -> bytes | None:
    """The next piece; None if none comes for a while, or something else ends."""
    coming = asyncio.ensure_future(pieces.get())
    try:
        await asyncio.wait({coming, *ends}, timeout=LOOK_S, return_when=asyncio.FIRST_COMPLETED)
    finally:
        if not coming.done():
            coming.cancel()
    return coming.result() if coming.done() and not coming.cancelled() else None
