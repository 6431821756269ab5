"""Frames of a bus as a DBC file describes them: last, least and largest value of every signal that came."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from drivers.can.batches import ERROR, EXTENDED, EXTENDED_ID, PRIORITY, REMOTE, by_id
from drivers.can.checks import LEAST_COUNTER_BITS
from drivers.can.dbc import never_negative, selecting_values, signal_field
from drivers.counter_search import LEAST_COUNTS
from drivers.fields import FieldGroup, LayoutError, j1939_valid_raw
from drivers.sniffing import span

if TYPE_CHECKING:
    from collections.abc import Sequence

    from cantools.database.can import Message
    from cantools.database.can.signal import Signal
    from numpy.typing import NDArray

    from drivers.can.batches import CanBatch
    from drivers.fields import Payloads


_LEAST_CLOCK_BITS = 12
_FEW = 0.01
_LEAST_JUMP_BITS = 8
_LEAST_STEPS = 20
_MANY_JUMPS = 0.05
"""Of the steps from value to value: a noisy signal hardly ever crosses half of its range in one of them."""


class SignalTraffic:
    """What came of one signal.

    Args:
        message: the message that it is in.
        signal: as the DBC file describes it.

    Attributes:
        name: its name.
        unit: its unit; empty if the DBC file gives none.
        unsigned: whether none of its values can be below 0.
        multiplexed: whether only some frames of the message have it.
        frames: how many frames had a value of it.
        last: the last value in its unit; NaN if none came.
        least: the least one.
        most: the largest one.
        stated: least and largest value by the DBC file; None where it states none.
        outside: how many frames had a value beyond these that has no name.

    Raises:
        LayoutError: no number can lie where the DBC file puts it.
    """

    def __init__(self, message: Message, signal: Signal) -> None:
        self.name, self.unit = str(signal.name), str(signal.unit or "")
        self.frames = 0
        self.last = self.least = self.most = math.nan
        self.unsigned = never_negative(signal)
        cell = signal_field(signal)
        length = int(message.length)
        if not all(0 <= position < 8 * length for position in cell.positions):
            raise LayoutError(f"{self.name} does not lie within the {length} bytes of its message")
        self._group = FieldGroup([cell], [0], length)
        self._scale, self._offset = float(signal.scale), float(signal.offset)
        self._valid = j1939_valid_raw(cell) if message.protocol == "j1939" else None
        signals = {one.name: one for one in message.signals}
        self._selectors = [
            (FieldGroup([signal_field(signals[name])], [0], length), sorted(values))
            for name, values in selecting_values(signals, [signal.name]).items()
        ]
        self._choices = {int(value): f"{text}" for value, text in (signal.choices or {}).items()}
        self._last_raw: int | None = None
        self.stated = tuple(None if end is None else float(end) for end in (signal.minimum, signal.maximum))
        self.outside = 0
        self._bits = cell.bits
        self._may_jump = cell.kind != "float" and cell.bits >= _LEAST_JUMP_BITS and not self._choices
        self._jumps = self._steps = 0
        self.multiplexed = bool(self._selectors)
        self._may_count = cell.kind == "unsigned" and self._scale == 1 and cell.bits >= LEAST_COUNTER_BITS
        self._may_rise = cell.kind == "unsigned" and cell.bits >= _LEAST_CLOCK_BITS and not self.multiplexed
        self._mask = np.uint64(2**cell.bits - 1)
        self._odd = 0
        self._before = np.empty(0, np.uint64)

    @property
    def counts(self) -> bool:
        """Whether it grew by 1 from frame to frame, but for a few frames that were lost."""
        return self._may_count and self.frames > LEAST_COUNTS and self._odd <= _FEW * self.frames

    @property
    def rises(self) -> bool:
        """Whether it grew from frame to frame, as a time or an hour meter does, until it began again at 0."""
        return self._may_rise and self.frames > LEAST_COUNTS and self.most > self.least

    @property
    def named(self) -> bool:
        """Whether the DBC file has names for its values, as for those of a state."""
        return bool(self._choices)

    @property
    def choice(self) -> str:
        """What the DBC file calls the last value; empty if it does not name it."""
        return "" if self._last_raw is None else self._choices.get(self._last_raw, "")

    @property
    def doubt(self) -> str:
        """What is strange about its values if the DBC file is that of the device; empty if nothing is."""
        unit = f" {self.unit}" if self.unit else ""
        if self.outside:
            least, most = self.stated
            ends = (
                f"at least {least:g}"
                if most is None
                else f"at most {most:g}"
                if least is None
                else f"{least:g} to {most:g}"
            )
            return (
                f"{self.name} reads {span(self.least, self.most)}{unit}, in {self.outside:,} of "
                f"{self.frames:,} frames beyond what the DBC file states ({ends}): is it the file of this "
                "device?"
            )
        may_jump = self._may_jump and not self.counts and not self.rises
        if may_jump and self._steps >= _LEAST_STEPS and self._jumps > _MANY_JUMPS * self._steps:
            return (
                f"{self.name} jumps by more than half of what its {self._bits} bits can carry, in "
                f"{self._jumps:,} of {self.frames:,} frames: is the DBC file that of this device?"
            )
        return ""

    def take(self, payloads: Payloads) -> None:
        """The next frames of the message ``[n, length]``."""
        for group, values in self._selectors:
            payloads = payloads[np.isin(group.read(payloads)[:, 0], values)]
        if not len(payloads):
            return
        raw = self._group.read(payloads)[:, 0]
        if self._may_count or self._may_rise:
            counts = np.concatenate((self._before, raw.astype(np.uint64)))
            steps = np.diff(counts) & self._mask
            odd = steps != 1
            # Frames may be lost while it is listened; what begins again too early counts no frames.
            self._may_count = self._may_count and not bool((counts[1:][odd] <= 1).any())
            self._odd += int(odd.sum())
            self._may_rise = self._may_rise and bool(((steps > 0) & (steps < self._mask // 2)).all())
            self._before = counts[-1:]
        self._note(raw.astype(np.float64))
        self._last_raw = None if raw.dtype.kind == "f" else int(raw[-1])

    def _note(self, raw: NDArray[np.float64]) -> None:
        if self._valid is not None:
            raw = raw[(raw >= self._valid[0]) & (raw <= self._valid[1])]
        raw = raw[np.isfinite(raw)]
        values = raw * self._scale + self._offset
        if not len(values):
            return
        before = values[:1] if math.isnan(self.last) else [self.last]
        self._steps += len(values) - math.isnan(self.last)
        half = 2.0 ** (self._bits - 1) * abs(self._scale)
        self._jumps += int((np.abs(np.diff(values, prepend=before)) > half).sum())
        least, most = self.stated
        unnamed = values[~np.isin(raw, list(self._choices))]
        rounding = 0.5 * abs(self._scale)
        self.outside += int((unnamed < least - rounding).sum()) if least is not None else 0
        self.outside += int((unnamed > most + rounding).sum()) if most is not None else 0
        self.frames += len(values)
        self.last = float(values[-1])
        self.least = float(np.fmin(self.least, values.min()))
        self.most = float(np.fmax(self.most, values.max()))


class MessageTraffic:
    """What came of one message.

    Args:
        message: as the DBC file describes it.

    Attributes:
        name: its name.
        frame_id: its id without flags.
        extended: whether that has 29 bits.
        length: bytes that the DBC file gives it.
        ids: ids that came, with their flags; several where SAE J1939 messages come with several priorities.
        frames: frames that came.
        short: those of them that are shorter than the DBC file states; they are left out.
        signals: those that came, and those that did not.
        unusable: why a signal cannot be read.
    """

    def __init__(self, message: Message) -> None:
        self.name, self.frame_id = str(message.name), int(message.frame_id)
        self.extended, self.length = bool(message.is_extended_frame), int(message.length)
        self.ids: set[int] = set()
        self.frames = self.short = 0
        self.signals: list[SignalTraffic] = []
        self.unusable: list[str] = []
        self._told_apart = EXTENDED | EXTENDED_ID
        if message.protocol == "j1939":
            self._told_apart &= ~PRIORITY
        for signal in message.signals:
            try:
                self.signals.append(SignalTraffic(message, signal))
            except LayoutError as error:
                self.unusable.append(f"{error}")

    @property
    def counter(self) -> SignalTraffic | None:
        """The first signal that counts all frames."""
        return next((one for one in self.signals if one.counts and not one.multiplexed), None)

    def has(self, frame_id: int) -> bool:
        """Whether an id, with its flags, is the message's."""
        own = self.frame_id | (EXTENDED if self.extended else 0)
        return (frame_id & self._told_apart) == (own & self._told_apart)

    def take(self, frame_id: int, data: NDArray[np.uint8], lengths: NDArray[np.int64]) -> None:
        """The next frames: data ``[n, 64]`` and their lengths ``[n]``."""
        self.ids.add(frame_id)
        self.frames += len(lengths)
        long_enough = lengths >= self.length
        self.short += int((~long_enough).sum())
        payloads = np.ascontiguousarray(data[long_enough, : self.length])
        if len(payloads):
            for signal in self.signals:
                signal.take(payloads)


class DbcTraffic:
    """A bus as a DBC file describes it.

    Args:
        messages: all that the file describes.
    """

    def __init__(self, messages: Sequence[Message]) -> None:
        self.messages = [MessageTraffic(message) for message in messages]
        self._of_id: dict[int, MessageTraffic | None] = {}

    @property
    def heard(self) -> list[MessageTraffic]:
        """Messages that came, in the order of the file."""
        return [message for message in self.messages if message.frames]

    @property
    def missing(self) -> list[MessageTraffic]:
        """Messages that did not come."""
        return [message for message in self.messages if not message.frames]

    def message_of(self, frame_id: int) -> MessageTraffic | None:
        """The message that an id, with its flags, belongs to; None of remote frames."""
        if frame_id not in self._of_id:
            found = (message for message in self.messages if message.has(frame_id))
            self._of_id[frame_id] = None if frame_id & REMOTE else next(found, None)
        return self._of_id[frame_id]

    def take(self, batch: CanBatch) -> None:
        """Decode a batch."""
        for frame_id, rows in by_id(batch.ids):
            if not frame_id & ERROR and (message := self.message_of(frame_id)) is not None:
                message.take(frame_id, batch.data[rows], batch.lengths[rows])
