"""What has a number and is not in the journal yet: messages, and marks that others are sent.

Nearly always that is what the next commit takes. While the disk takes no writes it grows, and the messages go
to the broker from here.
"""

from __future__ import annotations

from itertools import islice
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from daqsvc.outbox.messages import OutboxMessage


class Acknowledged(NamedTuple):
    """What became of acknowledgements.

    Attributes:
        from_memory: how many were for messages that are not on the disk.
        given_up: numbers that are waited for no longer, as too many are: no message will have them.
    """

    from_memory: int
    given_up: list[int]


class Unwritten:
    """Messages in the order of their numbers, and acknowledgements by number.

    Args:
        sent_kept: how many messages that the broker has may wait here for the disk. Of more, those go that a
            later one of their topic has overtaken, so that a disk that takes nothing for weeks does not fill
            the memory.
    """

    def __init__(self, sent_kept: int) -> None:
        self._sent_kept = sent_kept
        self._messages: dict[int, OutboxMessage] = {}
        self._marks: dict[int, None] = {}  # in the order in which they came
        self._sent_here = 0

    def __bool__(self) -> bool:
        return bool(self._messages or self._marks)

    @property
    def messages(self) -> Iterable[OutboxMessage]:
        """All messages."""
        return self._messages.values()

    @property
    def marks(self) -> frozenset[int]:
        """All acknowledgements."""
        return frozenset(self._marks)

    @property
    def first(self) -> int | None:
        """The lowest number of a message; None without any."""
        return next(iter(self._messages), None)

    @property
    def last(self) -> int | None:
        """The highest number of a message; None without any."""
        return next(reversed(self._messages), None)

    def marks_elsewhere(self) -> int:
        """How many acknowledgements are for messages of the journal."""
        return len(self._marks) - self._sent_here

    def add(self, message: OutboxMessage) -> None:
        """Take in a message; its number is above all others."""
        self._messages[message.sequence] = message

    def acknowledge(self, numbers: Iterable[int]) -> Acknowledged:
        """Take in that the broker has these messages."""
        before = self._sent_here
        for number in numbers:
            if number not in self._marks:
                self._marks[number] = None
                self._sent_here += number in self._messages
        from_memory = self._sent_here - before
        over = self._sent_here - self._sent_kept
        given_up = list(islice(self._overtaken(), over)) if over > self._sent_kept // 8 else []
        for number in given_up:
            del self._messages[number]
            self._marks.pop(number)
        self._sent_here -= len(given_up)
        return Acknowledged(from_memory, given_up)

    def next(self, limit: int) -> tuple[list[OutboxMessage], list[int]]:
        """The first messages, and marks that can be made once these are in the journal; ``limit`` of each."""
        messages = list(islice(self._messages.values(), limit))
        last = messages[-1].sequence if messages else 0
        marks = (mark for mark in self._marks if mark <= last or mark not in self._messages)
        return messages, list(islice(marks, limit))

    def written(self, messages: Iterable[OutboxMessage], marks: Iterable[int]) -> None:
        """These are in the journal."""
        for message in messages:
            del self._messages[message.sequence]
            self._sent_here -= message.sequence in self._marks
        for mark in marks:
            self._marks.pop(mark)

    def _overtaken(self) -> Iterator[int]:
        newest = {message.topic: number for number, message in self._messages.items() if message.retain}
        for number, message in self._messages.items():
            if number in self._marks and not (message.retain and newest[message.topic] == number):
                yield number
