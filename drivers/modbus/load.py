"""How much of a serial Modbus line's time its polling takes: an estimate from its characters and silences.

A request of a read has 8 characters and its reply 5 beside two for each register (Modbus Application
Protocol 1.1b3, 6). Each character has 11 bits, or 10 without parity and a second stop bit. Before the reply,
and before the next request, the line is silent for 3.5 characters, 1.75 ms at least (Modbus over serial line
1.02, 2.5.1.1). How long a unit takes until it answers is not known: `USUAL_ANSWER_S` is a usual time.
"""

from __future__ import annotations

import math
from contextlib import suppress
from itertools import pairwise
from typing import TYPE_CHECKING, NamedTuple

from daqsvc.settings.section import UnusableValueError
from drivers.modbus.settings import (
    MAX_REGISTERS,
    FifoLayout,
    ModbusRtuBus,
    RegistersLayout,
    RingLayout,
    WaveformLayout,
)

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from daqsvc.settings.models import MachineFile
    from drivers.modbus.settings import RegisterChannel

USUAL_ANSWER_S = 0.010
"""Units on serial lines take a few ms to some tens of them until they answer."""

_READ, _REPLY = 8, 5
"""Characters of a request to read and of its reply, registers apart."""
_WRITE, _WRITTEN = 9, 8
"""Of a request to write registers, these apart, and of its reply."""
_LEAST_GAP_S = 1.75e-3


class LineLoad(NamedTuple):
    """What the polling of a line takes of its time.

    Attributes:
        requests_per_s: requests in a second.
        least: share of the time if every unit answers as soon as it may.
        usual: share of the time if each takes `USUAL_ANSWER_S`.
    """

    requests_per_s: float
    least: float
    usual: float


class _Asked(NamedTuple):
    """What is asked again and again: requests and characters in a second."""

    requests_per_s: float
    characters_per_s: float

    @classmethod
    def reads(cls, requests: Iterable[int], per_s: float) -> _Asked:
        """Reads of these numbers of registers, each at this rate."""
        counts = list(requests)
        return cls(per_s * len(counts), per_s * sum(_READ + _REPLY + 2 * count for count in counts))

    @classmethod
    def write(cls, registers: int, per_s: float) -> _Asked:
        """A write of this number of registers."""
        return cls(per_s, per_s * (_WRITE + _WRITTEN + 2 * registers))


def line_load(draft: MachineFile, name: str, bus: ModbusRtuBus) -> LineLoad:
    """What the polling of all streams on a serial line takes of its time.

    Streams of one unit, table and rate share requests where that saves some. Of a ring and a queue the
    samples count, and not how often they are looked for; of waveforms those that are asked for.

    Args:
        draft: the machine file, or what is valid of it.
        name: of the bus.
        bus: the line.
    """
    asked: list[_Asked] = []
    together: dict[tuple[int, str, float], list[RegistersLayout]] = {}
    for stream in draft.streams.values():
        with suppress(UnusableValueError):
            layout = stream.layout
            if stream.bus != name:
                continue
            if isinstance(layout, RegistersLayout):
                together.setdefault((layout.unit, layout.table, stream.rate_hz), []).append(layout)
            elif isinstance(layout, FifoLayout | RingLayout):
                asked += _samples(layout, stream.rate_hz)
            elif isinstance(layout, WaveformLayout):
                asked += _blocks(layout)
    for (_, _, rate_hz), layouts in together.items():
        asked.append(_Asked.reads(_requests(layouts), rate_hz))
    requests_per_s = sum(one.requests_per_s for one in asked)
    character_s = (1 + 8 + (bus.parity != "none") + bus.stop_bits) / bus.baud
    gap_s = max(3.5 * character_s, _LEAST_GAP_S)
    silence_s, wire_s = requests_per_s * gap_s, sum(one.characters_per_s for one in asked) * character_s
    least = wire_s + 2.0 * silence_s
    return LineLoad(requests_per_s, least, wire_s + silence_s + requests_per_s * max(gap_s, USUAL_ANSWER_S))


def _requests(layouts: Sequence[RegistersLayout]) -> list[int]:
    """Registers of each request that reads these streams: together, where that saves requests."""
    apart = [count for one in layouts for count in _runs(one.channels, one.max_gap, one.max_count)]
    shared = _runs(
        [channel for one in layouts for channel in one.channels],
        min(one.max_gap for one in layouts),
        min(one.max_count for one in layouts),
    )
    return shared if len(shared) < len(apart) else apart


def _runs(channels: Sequence[RegisterChannel], max_gap: int, max_count: int) -> list[int]:
    """Registers of each of the fewest requests that read all channels; forbidden ranges make more of them."""
    places = sorted((channel.address, channel.address + channel.registers) for channel in channels)
    runs = [list(places[0])]
    for (_, before), (begin, end) in pairwise(places):
        merged = max(runs[-1][1], end)
        if begin - max(before, runs[-1][1]) <= max_gap and merged - runs[-1][0] <= max_count:
            runs[-1][1] = merged
        else:
            runs.append([begin, end])
    return [end - begin for begin, end in runs]


def _samples(layout: FifoLayout | RingLayout, rate_hz: float) -> Iterable[_Asked]:
    """Counted samples, as many in a reply as it has room for."""
    count = layout.count.registers
    at_once = max(layout.samples_per_read, 1)
    registers = at_once * layout.sample_registers
    if isinstance(layout, RingLayout):
        # The count is read before and after, once in all the room of the ring at least.
        yield _Asked.reads([registers], rate_hz / at_once)
        yield _Asked.reads([count, count], rate_hz / layout.depth)
        return
    yield _Asked.reads([registers + count], rate_hz / at_once)
    if layout.acknowledge is not None:
        yield _Asked.write(count, rate_hz / at_once)


def _blocks(layout: WaveformLayout) -> Iterable[_Asked]:
    """Blocks that the device is asked to take; how often it takes others is not known."""
    if layout.trigger is None:
        return
    per_s = 1.0 / layout.trigger.every_s
    registers = layout.samples * layout.sample_registers
    yield _Asked.reads([MAX_REGISTERS], per_s * registers / MAX_REGISTERS)
    yield _Asked.write(1, per_s)
    yield _Asked.reads([1, 1], per_s)
    if layout.page is not None:
        yield _Asked.write(1, per_s * math.ceil(registers / layout.page.registers))
