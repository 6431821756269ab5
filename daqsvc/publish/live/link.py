"""Sends live data over the broker to viewers, while their leases last."""

from __future__ import annotations

import asyncio
import json
import logging
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from pydantic import ValidationError

from daqsvc.alarms.commands import faults_of
from daqsvc.errors.code import coded
from daqsvc.errors.command_line import NO_SUCH_MACHINE
from daqsvc.errors.outputs import COMMAND_NOT_OBEYED, NOT_SHOWN
from daqsvc.publish.live.pieces import Packer
from daqsvc.publish.live.request import MOST_BYTES, LiveRequestPayload
from daqsvc.publish.looking import Looking
from daqsvc.publish.mqtt.errors import PublishRefusedError
from daqsvc.publish.mqtt.link import MqttLink

if TYPE_CHECKING:
    from daqsvc.errors.code import Code
    from daqsvc.publish.live.settings import Live
    from daqsvc.publish.looking import Look
    from daqsvc.publish.mqtt.connection import Connection, Incoming
    from daqsvc.publish.topics import LiveTopic, Topics

log = logging.getLogger(__name__)

MOST_REQUESTS = 64
"""That wait to be examined; further ones are dropped, and asked again by who means them."""
PIECE_EXPIRY_S = 10.0
"""How long a piece is of use."""
OVER = b'{"over":true}\n'
"""The last line where a machine is watched otherwise from now on, or not at all."""


@dataclass(slots=True)
class _Looker:
    """One viewer.

    Attributes:
        feed: the number of its feed.
        until_s: when the lease is over, by the loop's clock.
        task: sends the feed.
    """

    feed: int
    until_s: float
    task: asyncio.Task[None]


class LiveLink(MqttLink):
    """Sends the live data of machines in pieces, one at a time, to the viewers that have asked for it.

    Each piece waits for its PUBACK: on a slow link samples are left out, which the feed reports, and an alarm
    waits for one piece at most.

    Args:
        settings: how many viewers, and how much they are sent.
        look: begins a feed.
        topics: the box.
    """

    name = "live viewers"

    def __init__(self, settings: Live, look: Look, topics: Topics) -> None:
        self._settings = settings
        self._look = look
        self._topics = topics
        self._asked: asyncio.Queue[tuple[LiveTopic, LiveRequestPayload]] = asyncio.Queue(MOST_REQUESTS)
        self._lookers: dict[LiveTopic, _Looker] = {}
        self._sending = asyncio.Lock()
        self._free_s = 0.0
        self._has_warned = False

    def take(self, message: Incoming) -> bool:
        """Take in a request; see `MqttLink.take`."""
        topic = self._topics.live_request_of(message.topic)
        if topic is None:
            return False
        if message.retain or self._asked.full():
            return True  # one of long ago, or a flood
        try:
            if len(message.payload) > MOST_BYTES:
                raise ValueError(f"it has more than {MOST_BYTES} bytes")  # noqa: TRY301 - reported as others are
            request = LiveRequestPayload.read(message.payload)
        except (ValueError, RecursionError) as error:
            fault = faults_of(error, "payload")[0] if isinstance(error, ValidationError) else f"{error}"
            level = logging.DEBUG if self._has_warned else logging.WARNING
            self._has_warned = True
            log.log(
                level,
                "a request on %.200r is no daqsvc.live-request/1: %.300s",
                message.topic,
                fault,
                extra=coded(COMMAND_NOT_OBEYED),
            )
            return True
        self._asked.put_nowait((topic, request))
        return True

    async def run(self, connection: Connection) -> None:
        """Serve viewers over one connection; see `MqttLink.run`.

        Raises:
            MqttError: the connection is lost.
        """
        if await connection.watch(self._topics.live_requests, fresh_only=True):
            log.warning(
                "the MQTT broker does not let this client subscribe to %s: no live data is sent over it",
                self._topics.live_requests,
                extra=coded(NOT_SHOWN),
            )
        asking = asyncio.ensure_future(self._asked.get())
        try:
            while True:
                tasks: list[asyncio.Future[Any]] = [asking, *(one.task for one in self._lookers.values())]
                await asyncio.wait(tasks, timeout=self._soonest_s(), return_when=asyncio.FIRST_COMPLETED)
                if asking.done():
                    topic, request = asking.result()
                    asking = asyncio.ensure_future(self._asked.get())
                    await self._take_request(connection, topic, request)
                await self._end_those_over()
        finally:
            asking.cancel()
            await self._end([*self._lookers])

    def _soonest_s(self) -> float | None:
        """How long until the next lease is over; None if there is none."""
        if not self._lookers:
            return None
        now_s = asyncio.get_running_loop().time()
        return max(min(one.until_s for one in self._lookers.values()) - now_s, 0.0)

    async def _end_those_over(self) -> None:
        """End those whose lease is over; a loss of the connection in one of them is that of all.

        Raises:
            MqttError: the connection is lost.
        """
        now_s = asyncio.get_running_loop().time()
        over = [topic for topic, one in self._lookers.items() if one.until_s <= now_s]
        ended = [topic for topic, one in self._lookers.items() if one.task.done()]
        failed = [self._lookers[topic].task for topic in ended]
        await self._end(dict.fromkeys([*over, *ended]))
        for task in failed:
            task.result()

    async def _end(self, topics: list[LiveTopic] | dict[LiveTopic, None]) -> None:
        tasks = [self._lookers.pop(topic).task for topic in topics]
        for task in tasks:
            task.cancel()
        if tasks:
            await asyncio.wait(tasks)

    async def _take_request(
        self, connection: Connection, topic: LiveTopic, request: LiveRequestPayload
    ) -> None:
        until_s = asyncio.get_running_loop().time() + request.lease_s
        known = self._lookers.get(topic)
        if known is not None and known.feed == request.feed:
            known.until_s = until_s
            return
        if known is not None:
            await self._end([topic])
        if request.lease_s == 0.0:
            return
        refused = ""
        if len(self._lookers) >= self._settings.max_viewers:
            refused = (
                f"it has {len(self._lookers)} viewers already: close one of their pages, or raise "
                "max_viewers in [mqtt.live]"
            )
        task = asyncio.create_task(
            self._serve(connection, topic, request, refused), name=f"viewer {topic.looker}"
        )
        self._lookers[topic] = _Looker(request.feed, until_s, task)

    async def _serve(
        self, connection: Connection, topic: LiveTopic, request: LiveRequestPayload, refused: str
    ) -> None:
        """Serve one viewer, or refuse it; if the broker refuses the feed, only that feed ends."""
        try:
            if refused:
                await self._refuse(connection, topic, request.feed, refused, NOT_SHOWN)
            else:
                await self._tell(connection, topic, request)
        except PublishRefusedError as error:
            log.warning(
                "live data of %s is no longer sent to a viewer: %s",
                topic.machine,
                error,
                extra=coded(NOT_SHOWN),
            )

    async def _refuse(
        self, connection: Connection, topic: LiveTopic, feed: int, why: str, code: Code
    ) -> None:
        line = json.dumps({"accepted": False, "reason": why, "code": code.id}).encode() + b"\n"
        await self._send(connection, topic, Packer(feed).pack(line))

    async def _tell(self, connection: Connection, topic: LiveTopic, request: LiveRequestPayload) -> None:
        before_bytes = round(self._settings.max_kb_per_s * 1000 / 2)
        looking = self._look(topic.machine, request.streams, before_bytes=before_bytes)
        if not isinstance(looking, Looking):
            why = (
                f"there is no machine {topic.machine!r:.200} here; alarms under that name are of the service"
            )
            await self._refuse(connection, topic, request.feed, why, NO_SUCH_MACHINE)
            return
        packer = Packer(request.feed)
        try:
            while lines := await looking.lines():
                await self._send(connection, topic, await asyncio.to_thread(packer.pack, lines))
            await self._send(connection, topic, packer.pack(OVER))
        finally:
            looking.leave()

    async def _send(self, connection: Connection, topic: LiveTopic, pieces: list[bytes]) -> None:
        """Send pieces, no faster than the limit for all viewers together."""
        there = self._topics.live_feed(topic.machine, topic.looker)
        loop = asyncio.get_running_loop()
        for piece in pieces:
            begun_s = max(loop.time(), self._free_s)
            self._free_s = begun_s + len(piece) / (self._settings.max_kb_per_s * 1000)
            await asyncio.sleep(begun_s - loop.time())
            async with self._sending:  # an alarm waits for one piece, however many viewers there are
                await connection.deliver(there, piece, retain=False, expiry_s=PIECE_EXPIRY_S)
