"""Listening to one machine, over whatever: what it tells is kept, and asked for again when that ends."""

from __future__ import annotations

import asyncio
import contextlib
import time
from abc import ABC, abstractmethod
from typing import TYPE_CHECKING, Any

from daqsvc.acquisition.clock import NS_PER_S
from daqsvc.acquisition.link import Backoff
from daqsvc.live_feed import SCHEMA
from daqsvc.page.machine_live import MachineLive

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator
    from pathlib import Path

    Document = dict[str, Any]

NOT_OURS = (ValueError, LookupError, TypeError)
"""What comes of an answer that is not as it is known here."""


class Listening(ABC):
    """Listens to one machine and keeps what it reports; a subclass knows the way.

    Args:
        machine: its name.
        history: the file of the history of its box, if there can be one here.
    """

    def __init__(self, machine: str, history: Path | None) -> None:
        self.machine = machine
        self.live: MachineLive | None = None
        """What was received; None before the first message."""
        self.why_not = "the service has not answered yet"
        """Why nothing is received at present; empty if something is."""
        self.heard_s = time.monotonic()
        """When something was last received."""
        self.streams: frozenset[str] = frozenset()
        """Those whose samples are to be asked for."""
        self.anew = asyncio.Event()
        """Whether it has to be asked for again, as other streams are wanted."""
        self._history = history
        self._wanted: dict[object, frozenset[str]] = {}
        self._has_begun = asyncio.Event()

    @abstractmethod
    async def listen(self, backoff: Backoff) -> None:
        """Ask for the `streams`, and take what comes, until that ends or `anew` is set.

        Args:
            backoff: to be reset as soon as something comes.
        """

    def in_words(self, error: Exception) -> str:
        """Why nothing is received, for a person."""
        return f"{error}" or type(error).__name__

    async def first(self, timeout_s: float) -> MachineLive | None:
        """The machine, as soon as something was received about it; None if nothing is in time."""
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(timeout_s):
                await self._has_begun.wait()
        return self.live

    @contextlib.contextmanager
    def wanting(self, streams: Iterable[str]) -> Iterator[None]:
        """Have the samples of streams come meanwhile."""
        who = object()
        self._wanted[who] = frozenset(streams)
        self._ask_anew()
        try:
            yield
        finally:
            del self._wanted[who]
            self._ask_anew()

    def _ask_anew(self) -> None:
        wanted = frozenset().union(*self._wanted.values())
        # What is wanted no more goes on coming until something else is: it costs less than asking again.
        if wanted - self.streams or (self.streams and not wanted):
            self.anew.set()

    async def run(self) -> None:
        """Listen until cancelled; again and again where that fails."""
        backoff = Backoff()
        while True:
            self.anew.clear()
            self.streams = frozenset().union(*self._wanted.values())
            try:
                await self.listen(backoff)
            except (OSError, asyncio.IncompleteReadError, *NOT_OURS) as error:
                self.why_not = self.in_words(error)
                if isinstance(error, NOT_OURS):
                    self._has_begun.set()  # it has answered: waiting for what it refuses has no use
            if not self.anew.is_set():
                await asyncio.sleep(backoff.next_ns() / NS_PER_S)

    def begin(self, about: Document) -> None:
        """Take the first line of `daqsvc.live_feed`.

        Raises:
            ValueError: it is a refusal, or of another version.
        """
        if about.get("schema") != SCHEMA:
            raise ValueError(str(about.get("reason", "it answers in a way that is not known here")))
        before = self.live
        self.live = MachineLive(about)
        self.live.history = self._history
        if before is not None and before.about["streams"] == about["streams"]:
            self.live.go_on_from(before)
        self.why_not = ""
        self.heard_s = time.monotonic()
        self._has_begun.set()

    def take(self, line: Document) -> None:
        """Take a further line."""
        if self.live is not None:
            self.live.hear(line)
        self.heard_s = time.monotonic()


class Listenings:
    """Machines that are listened to while somebody looks at them, and a while longer.

    Args:
        linger_s: how much longer.
    """

    def __init__(self, linger_s: float) -> None:
        self._linger_s = linger_s
        self._listening: dict[str, tuple[Listening, asyncio.Task[None]]] = {}
        self._looking: dict[str, int] = {}

    def __contains__(self, machine: str) -> bool:
        """Whether a machine is listened to."""
        return machine in self._listening

    @contextlib.contextmanager
    def looking(self, machine: str, make: Callable[[], Listening]) -> Iterator[Listening]:
        """Listen to a machine meanwhile, together with all others who look at it.

        Args:
            machine: its name.
            make: what listens to it, if nothing does yet.
        """
        if machine not in self._listening:
            listening = make()
            task = asyncio.create_task(listening.run(), name=f"listen to {machine}")
            self._listening[machine] = listening, task
        self._looking[machine] = self._looking.get(machine, 0) + 1
        try:
            yield self._listening[machine][0]
        finally:
            self._looking[machine] -= 1
            asyncio.get_running_loop().call_later(self._linger_s, self._perhaps_end, machine)

    def _perhaps_end(self, machine: str) -> None:
        if not self._looking.get(machine):
            self._looking.pop(machine, None)
            if machine in self._listening:
                self._listening.pop(machine)[1].cancel()

    async def close(self) -> None:
        """Listen to none any more."""
        tasks = {task for _, task in self._listening.values()}
        self._listening.clear()
        for task in tasks:
            task.cancel()
        if tasks:
            await asyncio.wait(tasks)
