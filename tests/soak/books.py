"""The books of the samples: what the service says of each stream, against what its device knows.

A device writes the number of each sample beside it. So the newest sample that the service shows says how
many the device had taken by then, and what the service says of the stream must fit that whenever it is asked.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from soak.devices import Device

MISJUDGED = ("counter_restarts", "frames_rejected", "frames_set_aside", "frames_late")
"""Counters that stay 0: no device is restarted, and none sends what fits nothing."""


@dataclass
class Book:
    """Of one stream, for as long as the service counts it on.

    Attributes:
        name: machine and stream.
        device: whose samples they are.
        entries: how often it was compared.
        received: samples handed on, since the book was opened.
        lost: samples that never came.
        unsent: of these, those that the device itself could not send.
        steady_entries: of the entries, those between which nothing happened to the wire.
        next_number: the device's number of the sample behind the newest one.
    """

    name: str
    device: Device
    entries: int = 0
    received: int = 0
    lost: int = 0
    unsent: int = 0
    steady_entries: int = 0
    next_number: int = 0
    _zero: int = 0
    _begin: int = 0
    _opened_at: int = field(init=False)
    _steady: int | None = None

    def __post_init__(self) -> None:
        self._opened_at = self.device.disturbed_at - self.device.keeps

    def enter(
        self, counted: Mapping[str, Any], shown: float | None, disturbances: int, *, steady: bool
    ) -> Iterator[str]:
        """Compare; what does not fit, a sentence each.

        Args:
            counted: what the service has counted of the stream.
            shown: what was written beside the newest sample; None before the first.
            disturbances: how often the wire had been disturbed when the service was asked.
            steady: whether it was read without a break then.
        """
        received, lost, end = (counted[key] for key in ("samples_received", "samples_lost", "end_index"))
        if shown is None or not end:
            return
        number = self.device.number_of(shown)
        if not self.entries:
            self._zero, self._begin = number + 1 - end, end - received - lost
            self.next_number = self._zero + self._begin
            if self.next_number < self._opened_at:
                yield f"{self.name}: begins with sample {self.next_number}, taken before anybody listened"
        if self._begin + received + lost != end:
            yield (
                f"{self.name}: {received} samples received and {lost} lost since number {self._begin} do not "
                f"come to number {end}"
            )
        if number + 1 - end != self._zero:
            missing = number + 1 - end - self._zero
            what = "neither received nor lost" if missing > 0 else "accounted for twice"
            yield f"{self.name}: at sample {number} of the device {abs(missing)} samples are {what}"
            self._zero = number + 1 - end
        for key in MISJUDGED:
            if counted[key]:
                yield f"{self.name}: {key} is {counted[key]}, though its device did nothing of the kind"
        more_lost, unsent = lost - self.lost, self.device.unsent(self.next_number, number + 1)
        undisturbed = steady and self._steady == disturbances
        if undisturbed and more_lost != unsent:
            yield (
                f"{self.name}: {more_lost} samples were lost up to number {number} while nothing happened to "
                f"its wire, and the device could not send {unsent}"
            )
        elif more_lost < unsent:
            yield (
                f"{self.name}: the device could not send {unsent} samples up to number {number}, and only "
                f"{more_lost} count as lost"
            )
        self.entries += 1
        self.steady_entries += undisturbed
        self.received, self.lost, self.unsent = received, lost, self.unsent + unsent
        self.next_number = number + 1
        self._steady = disturbances if steady else None


@dataclass
class TrendBook:
    """Of a value that is asked for again and again: nobody counts it but the service's own schedule.

    Attributes:
        name: machine and stream.
        asked_before: requests that had been answered when the book was opened.
        received: samples handed on.
        lost: polls without a sample.
    """

    name: str
    asked_before: int
    received: int = 0
    lost: int = 0

    def enter(self, counted: Mapping[str, Any], answered: int) -> Iterator[str]:
        """Compare; see `Book.enter`.

        Args:
            counted: what the service has counted of the stream.
            answered: requests that the unit has answered by now.
        """
        self.received, self.lost = counted["samples_received"], counted["samples_lost"]
        if self.received + self.lost != counted["end_index"]:
            yield (
                f"{self.name}: {self.received} samples received and {self.lost} lost are not the "
                f"{counted['end_index']} polls that were due"
            )
        if self.received > answered - self.asked_before:
            yield (
                f"{self.name}: {self.received} samples received, and its unit has answered "
                f"{answered - self.asked_before} times"
            )


@dataclass
class Totals:
    """What all books of a stream come to, those that are closed too."""

    books: int = 0
    received: int = 0
    lost: int = 0
    unsent: int = 0
    entries: int = 0
    steady_entries: int = 0

    def add(self, book: Book) -> None:
        """Close a book."""
        self.books += book.entries > 0
        for key in ("received", "lost", "unsent", "entries", "steady_entries"):
            setattr(self, key, getattr(self, key) + getattr(book, key))


@dataclass
class Ledger:
    """All books.

    Attributes:
        books: those that are open, by machine.
        totals: by machine, of those that are closed.
    """

    books: dict[str, Book] = field(default_factory=dict)
    trend: TrendBook | None = None
    totals: dict[str, Totals] = field(default_factory=dict)

    def open(self, device: Device) -> None:
        """Begin a book anew: whoever counts the stream counts from 0."""
        self.close(device.name)
        self.books[device.name] = Book(f"{device.name}/casing", device)

    def close(self, machine: str) -> None:
        """End a book."""
        if (book := self.books.pop(machine, None)) is not None:
            self.totals.setdefault(machine, Totals()).add(book)
