"""Frames of a bus as a DBC file describes them: last, least and largest value of every signal that came."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from daqsvc.rounding import counted
from drivers.can.batches import ERROR, EXTENDED, EXTENDED_ID, REMOTE, by_id
from drivers.can.checks import LEAST_COUNTER_BITS
from drivers.can.dbc import j1939_valid, never_negative, selecting_values, signal_field, signals_by_page
from drivers.can.settings import CAN_FD_LENGTHS, PRIORITY
from drivers.counter_search import LEAST_COUNTS
from drivers.fields import FieldGroup, LayoutError
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
_MOST_STEPS = 100
"""Of different sizes: what has more of them varies, and counts nothing."""
_LEAST_JUMP_BITS = 8
_LEAST_STEPS = 20
_TWICE = 1.8
"""From two devices with one id, frames come about twice as often."""
_TOO_OFTEN = 1.5
"""Of the rate that a DBC file states: above it, it is no clock that is not exact."""
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
        mean: the mean of all.
        stated: least and largest value by the DBC file; None where it states none.
        outside: how many frames had a value beyond these that has no name.

    Raises:
        LayoutError: no number can lie where the DBC file puts it.
    """

    def __init__(self, message: Message, signal: Signal) -> None:
        self.name, self.unit = str(signal.name), str(signal.unit or "")
        self.frames = 0
        self.last = self.least = self.most = math.nan
        self.mean = self._squares = 0.0
        self.unsigned = never_negative(signal)
        cell = signal_field(signal)
        length = int(message.length)
        if not all(0 <= position < 8 * length for position in cell.positions):
            raise LayoutError(f"{self.name} does not lie within the {length} bytes of its message")
        self._group = FieldGroup([cell], [0], length)
        self._scale, self._offset = float(signal.scale), float(signal.offset)
        self._valid = j1939_valid(message, signal)
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
        self._grew: dict[int, tuple[int, int]] = {}
        """By how much it grew from frame to frame: how often, and the least value behind that."""
        self._before = np.empty(0, np.uint64)

    @property
    def step(self) -> int | None:
        """By how much it grew from frame to frame, but for a few frames that were lost; None if it varied."""
        if not self._may_count or self.frames <= LEAST_COUNTS or not self._grew:
            return None
        step = max(self._grew, key=lambda one: self._grew[one][0])
        others = [self._grew[one] for one in self._grew if one != step]
        # Frames may be lost while it is listened; what begins again too early counts nothing.
        steady = sum(many for many, _ in others) <= _FEW * self.frames
        begins_again = any(least <= step for _, least in others)
        return step if 0 < step <= int(self._mask) // 2 and steady and not begins_again else None

    @property
    def deviation(self) -> float:
        """The standard deviation of its values: the RMS about their mean."""
        return math.sqrt(self._squares / self.frames) if self.frames else 0.0

    @property
    def resolution(self) -> float:
        """What one count of it is worth."""
        return abs(self._scale)

    @property
    def counts(self) -> bool:
        """Whether it grew by 1 from frame to frame, but for a few frames that were lost."""
        return self.step == 1

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
        may_jump = self._may_jump and self.step is None and not self.rises
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
            self._note_steps(steps, counts[1:])
            self._may_rise = self._may_rise and bool(((steps > 0) & (steps < self._mask // 2)).all())
            self._before = counts[-1:]
        self._note(raw.astype(np.float64))
        self._last_raw = None if raw.dtype.kind == "f" else int(raw[-1])

    def _note_steps(self, steps: NDArray[np.uint64], behind: NDArray[np.uint64]) -> None:
        """Keep by how much it grew, and the values behind that, unless too many steps show that it varies."""
        if not self._may_count:
            return
        for step in np.unique(steps):
            values = behind[steps == step]
            many, least = self._grew.get(int(step), (0, int(values[0])))
            self._grew[int(step)] = many + len(values), min(least, int(values.min()))
        self._may_count = len(self._grew) <= _MOST_STEPS
        if not self._may_count:
            self._grew.clear()

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
        # Of the values before and of these, each about its own mean: sums of squares would lose the digits.
        apart = float(values.mean()) - self.mean
        share = len(values) / (self.frames + len(values))
        self._squares += float(values.var()) * len(values) + apart**2 * self.frames * share
        self.mean += apart * share
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
        long: those of them that are longer, beyond what CAN FD pads them to.
        signals: those that came, and those that did not.
        unusable: why a signal cannot be read.
    """

    def __init__(self, message: Message) -> None:
        self.name, self.frame_id = str(message.name), int(message.frame_id)
        self.extended, self.length = bool(message.is_extended_frame), int(message.length)
        self.ids: set[int] = set()
        self.frames = self.short = self.long = 0
        self._padded = next((one for one in CAN_FD_LENGTHS if one >= self.length), self.length)
        # Each page may come as often as the DBC file states.
        self._cycle_s = float(message.cycle_time or 0.0) / 1000.0 / max(len(signals_by_page(message)), 1)
        self.signals: list[SignalTraffic] = []
        self.unusable: list[str] = []
        self._id_mask = EXTENDED | EXTENDED_ID
        if message.protocol == "j1939":
            self._id_mask &= ~PRIORITY
        for signal in message.signals:
            try:
                self.signals.append(SignalTraffic(message, signal))
            except LayoutError as error:
                self.unusable.append(f"{error}")

    @property
    def counter(self) -> SignalTraffic | None:
        """The first signal that counts all frames."""
        return next((one for one in self.signals if one.counts and not one.multiplexed), None)

    @property
    def length_doubt(self) -> str:
        """That its frames are longer than the DBC file states, so that no stream reads them; empty if not."""
        if not self.long:
            return ""
        return (
            f"{self.long:,} of {counted(self.frames, 'frame')} of {self.name} have more than the "
            f"{self.length} bytes of the DBC file, and a stream does not read them: is it the file of this "
            "device?"
        )

    def rate_doubt(self, rate_hz: float | None) -> str:
        """That its frames come clearly more often than the DBC file states; empty if not.

        Args:
            rate_hz: of the id that comes most often.
        """
        # Who counts every frame is one device, however often it has been set to send.
        few = rate_hz is None or self.frames < _LEAST_STEPS or self.counter is not None
        if few or rate_hz is None or rate_hz * self._cycle_s < _TOO_OFTEN:
            return ""
        why = (
            "most likely two devices send it with one id, and their values mix."
            if rate_hz * self._cycle_s >= _TWICE
            else "the device is set to send it more often, or two devices send it with one id, and their "
            "values mix."
        )
        return (
            f"{self.name} comes {rate_hz:.3g} times a second, the DBC file states {1.0 / self._cycle_s:.3g} "
            f"(every {1000.0 * self._cycle_s:.3g} ms): {why}"
        )

    def has(self, frame_id: int) -> bool:
        """Whether an id, with its flags, is the message's."""
        own = self.frame_id | (EXTENDED if self.extended else 0)
        return (frame_id & self._id_mask) == (own & self._id_mask)

    def take(self, frame_id: int, data: NDArray[np.uint8], lengths: NDArray[np.int64]) -> None:
        """The next frames: data ``[n, 64]`` and their lengths ``[n]``."""
        self.ids.add(frame_id)
        self.frames += len(lengths)
        long_enough = lengths >= self.length
        self.short += int((~long_enough).sum())
        self.long += int((lengths > self._padded).sum())
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
            matches = (message for message in self.messages if message.has(frame_id))
            self._of_id[frame_id] = None if frame_id & REMOTE else next(matches, None)
        return self._of_id[frame_id]

    def take(self, batch: CanBatch) -> None:
        """Decode a batch."""
        for frame_id, rows in by_id(batch.ids):
            if not frame_id & ERROR and (message := self.message_of(frame_id)) is not None:
                message.take(frame_id, batch.data[rows], batch.lengths[rows])
