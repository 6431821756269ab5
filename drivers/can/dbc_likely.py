"""What of a DBC file a stream most likely reads: its message, the signal that counts, those that measure."""

from __future__ import annotations

import functools
import math
from typing import TYPE_CHECKING, Any

from drivers.bus_questions import is_count
from drivers.can.numbered import most_likely_samples, unit_names
from drivers.sniffing import TYPE_OF_UNIT

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence
    from pathlib import Path

    from cantools.database.can import Message


def with_signals(file: Path) -> dict[str, Message]:
    """The messages of a DBC file that hold signals, by name.

    Raises:
        LayoutError: the file cannot be read, or cantools is not installed.
    """
    changed_ns = file.stat().st_mtime_ns if file.is_file() else 0
    return _read_once(file.absolute(), changed_ns)


@functools.lru_cache(maxsize=1)
def _read_once(file: Path, changed_ns: int) -> dict[str, Message]:
    """The same; a large file takes seconds, and is asked about several times."""
    from drivers.can.dbc import messages_of  # noqa: PLC0415 - cantools is slow to import

    del changed_ns
    return {message.name: message for message in messages_of(file) if message.signals}


def by_page_of(message: Message) -> dict[str, list[str]]:
    """See `drivers.can.dbc.signals_by_page`."""
    from drivers.can.dbc import signals_by_page  # noqa: PLC0415 - cantools is slow to import

    return signals_by_page(message)


def come_together(signals: Mapping[str, Any], names: Iterable[str]) -> bool:
    """Whether some frame holds all of these signals."""
    from drivers.can.dbc import selecting_values  # noqa: PLC0415 - cantools is slow to import

    return all(selecting_values(signals, names).values())


def share_of_frames(message: Message, names: Sequence[str]) -> float:
    """Which part of the frames holds these signals, if all pages come equally often."""
    from drivers.can.dbc import selecting_values, values_of  # noqa: PLC0415 - cantools is slow to import

    pages = selecting_values({one.name: one for one in message.signals}, names)
    return math.prod(len(values) / len(values_of(message, selector)) for selector, values in pages.items())


def _of_pages(signals: Iterable[Any]) -> bool:
    """Whether any of the signals comes in some frames of its message only."""
    return any(one.multiplexer_ids for one in signals)


def never_negative(signal: Any) -> bool:
    """See `drivers.can.dbc.never_negative`."""
    from drivers.can import dbc  # noqa: PLC0415 - cantools is slow to import

    return dbc.never_negative(signal)


def likely_message(messages: Mapping[str, Message]) -> str:
    """The message that most likely carries samples: of vibration, with a counter, of numbers with units."""

    def score(message: Message) -> tuple[bool, bool, bool, int]:
        units = unit_names(message.signals, [one.name for one in message.signals])
        vibration = any(unit in TYPE_OF_UNIT for unit in units.values())
        counted = any(is_count(one.name) for one in message.signals)
        return (
            vibration,
            counted,
            not message.is_multiplexed(),
            sum(bool(one.unit) for one in message.signals),
        )

    return max(messages, key=lambda name: score(messages[name]))


def may_be_counters(message: Message) -> list[Any]:
    """Signals of a message that may count its frames by how they are made."""
    return [one for one in message.signals if _may_count(one, len(message.signals))]


def likely_counter(message: Message) -> str | None:
    """The signal that counts the frames of a stream by its name; None if there is none."""
    named = [one for one in may_be_counters(message) if is_count(one.name)]
    signals = {one.name: one for one in message.signals}
    if _of_pages(signals[name] for name in likely_measured(message.signals)):
        named = [one for one in named if _of_pages([one])]
    return next((str(one.name) for one in named), None)


def _may_count(signal: Any, signals: int) -> bool:
    plain = not signal.is_signed and not signal.is_float and signal.scale == 1 and signal.length >= 4
    return bool(plain) and signals > 1 and not signal.is_multiplexer


def likely_measured(signals: Sequence[Any], *, apart: bool = False) -> list[str]:
    """Names of what one stream measures: no states, no selectors, one page of a multiplexed message.

    Args:
        signals: of the message.
        apart: whether numbered signals are of separate sensors, so that others may be beside them.
    """
    numbers = [one for one in signals if not one.is_multiplexer and not one.choices]
    always = [one for one in numbers if one.multiplexer_ids is None]
    known = {one.name: one for one in signals}
    page: list[Any] = []
    for one in sorted((n for n in numbers if n.multiplexer_ids), key=lambda n: min(n.multiplexer_ids)):
        if come_together(known, [*(other.name for other in page), one.name]):
            page.append(one)
    for likely in (always, page):
        if with_unit := [one.name for one in likely if one.unit]:
            return (not apart and most_likely_samples(signals, with_unit)) or with_unit
    return [one.name for one in (always or page)[:1]]
