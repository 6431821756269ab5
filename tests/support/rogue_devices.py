"""Devices that do their worst on every kind of bus, from a fixed seed, and a sound one to compare with."""

from __future__ import annotations

import asyncio
import contextlib
import os
import threading
import time
from typing import TYPE_CHECKING, Any, NamedTuple, Self

import can
import numpy as np
from support.waiting import PATIENCE_S

from drivers.base import StreamSpec
from drivers.make import stream_layout
from drivers.serial.driver import framing_of
from drivers.serial.settings import SerialBus
from sim_hw.nodes.modbus_node import ModbusRtuServer, ModbusTcpServer, PlannedReply
from sim_hw.nodes.modbus_unit import ModbusUnit
from sim_hw.nodes.serial_node import PseudoTerminal

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence
    from pathlib import Path
    from typing import Any

    from daqsvc.settings import MachineFile
    from drivers.frames import FrameLayout

    Encode = Callable[[np.ndarray[Any, Any], np.ndarray[Any, Any]], list[bytes]]

TICK_S = 0.005
NOMINAL_HZ = 50.0
SLOW_HZ = 200.0
STILL = 3_000_000_077
"""No device has counted so far since it was started: nothing behind it is taken for samples since then."""
LEVELS = {"calm": 0.1, "loud": 8.0, "huge": 1e9}
"""RMS of what is measured, in the unit of the sensor: of 25 loud values never less than 3 by chance."""
FAULTS = (
    "none", "silent", "exception", "wrong unit", "wrong transaction", "wrong function", "wrong protocol",
    "truncated", "cut off", "oversized", "corrupt", "garbage",
)  # fmt: skip
RING, FIFO, TREND = 0, 1200, 400
"""Where the registers of a rogue Modbus unit are."""
RING_PLACES = range(16, 16 + 64)


class Phase(NamedTuple):
    """What a device does for a while.

    Attributes:
        name: of it.
        counter: how it counts.
        per_s: frames a second, or steps of its registers.
        damage: share of the frames of which some bytes are wrong.
        values: what it measures.
    """

    name: str
    counter: str = "sound"
    per_s: float = NOMINAL_HZ
    damage: float = 0.0
    values: str = "calm"


WORST = (
    Phase("still", counter="still"),
    Phase("random", counter="random"),
    Phase("random and fast", counter="random", per_s=4000.0),
    Phase("corrupt", damage=0.7, per_s=4 * NOMINAL_HZ),
    Phase("tenfold", per_s=10 * NOMINAL_HZ),
    Phase("huge", counter="extreme", values="huge"),
    Phase("noise", values="noise", per_s=4 * NOMINAL_HZ),
    Phase("hundredfold", per_s=100 * NOMINAL_HZ),
)


class RogueFrames:
    """What a device sends, phase by phase.

    Args:
        encode: makes frames of counters ``[n]`` and samples ``[n, 1, 1]``.
        seed: of whatever is random.
        text: whether its frames are lines of text.
    """

    def __init__(self, encode: Encode, seed: int, *, text: bool = False) -> None:
        self._encode = encode
        self._rng = np.random.default_rng(seed)
        self._text = text
        self._count = 0

    def frames(self, phase: Phase, n: int) -> list[bytes]:
        """The next frames of a phase."""
        rng = self._rng
        if not n:
            return []
        sound = (self._count + np.arange(n)) % 2**32
        self._count += n
        if phase.values == "noise":
            return [rng.bytes(int(size)) for size in rng.integers(0, 80, n)]
        counters = {
            "sound": sound,
            "still": np.full(n, STILL),
            "random": rng.integers(0, 2**32, n),
            "extreme": rng.choice(np.array([0, 1, 2**31 - 1, 2**31, 2**32 - 2, 2**32 - 1]), n),
        }[phase.counter]
        if phase.values == "huge" and self._text:
            odd = rng.choice(np.array(["1e39", "-1e308", "nan", "-inf", "9" * 400, "-0", "1e-400", ""]), n)
            counts = rng.choice(np.array(["-1", str(2**64), "1e9", "", "99999999999999999999999"]), n)
            return [f"{count},{value}\n".encode() for count, value in zip(counts, odd, strict=True)]
        level = LEVELS[phase.values]
        encoded = self._encode(counters.astype(np.int64), level * rng.normal(size=(n, 1, 1)))
        return [self._damaged(f) if rng.random() < phase.damage else f for f in encoded]

    def _damaged(self, frame: bytes) -> bytes:
        data = bytearray(frame)
        for at in self._rng.integers(0, len(data), 3).tolist():
            data[at] ^= int(self._rng.integers(1, 256))
        return bytes(data[: int(self._rng.integers(1, len(data) + 1))])


class ModbusRogue:
    """A unit whose counts, queue, values and replies are as bad as those of the others."""

    def __init__(self, seed: int) -> None:
        self._rng = np.random.default_rng(seed)
        self._phase = Phase("sound")
        self._count = 0.0
        self.unit = ModbusUnit()
        self.unit.map("holding", RING, 2)
        self.unit.map("holding", RING_PLACES.start, len(RING_PLACES))
        self.unit.map("holding", TREND, 2)
        self.unit.add_queue(FIFO, self._queue)

    def step(self, phase: Phase, n: int) -> None:
        """Count on by as many samples."""
        self._phase = phase
        self._count = (self._count + n) % 2**32
        self.unit.put("holding", RING, self._counter())
        self.unit.put("holding", RING_PLACES.start, self._values(2 * len(RING_PLACES)))
        self.unit.put("holding", TREND, self._rng.bytes(4))

    def plan(self, unit: int, pdu: bytes) -> PlannedReply:
        """What becomes of a reply."""
        del unit, pdu
        spoilt = self._phase.damage or float(self._phase.values == "noise")
        if self._rng.random() >= spoilt:
            return PlannedReply()
        fault: Any = FAULTS[int(self._rng.integers(len(FAULTS)))]
        return PlannedReply(fault, int(self._rng.integers(0, 20_000_000)))

    def _counter(self) -> bytes:
        count = {
            "still": STILL,
            "random": int(self._rng.integers(0, 2**32)),
            "extreme": int(self._rng.choice(np.array([0, 2**31, 2**32 - 1]))),
        }.get(self._phase.counter, int(self._count))
        return count.to_bytes(4, "big")

    def _values(self, size: int) -> bytes:
        if self._phase.values == "huge":
            return self._rng.bytes(size)
        raw = round(1000.0 * LEVELS.get(self._phase.values, 0.1))
        return (raw.to_bytes(2, "big", signed=True) + (-raw).to_bytes(2, "big", signed=True)) * (size // 4)

    def _queue(self) -> bytes:
        most = 80 if self._phase.values == "noise" else 29
        return self._counter() + self._rng.bytes(2 * int(self._rng.integers(0, most)))


class Node:
    """A device in the thread: plays its phases in turn, round by round, at real time.

    Attributes:
        phases: what it plays; others take over when the round is over.
        rounds: how often it has played them all.
    """

    def __init__(self, name: str, step: Callable[[Phase, int], None], phases: Sequence[Phase]) -> None:
        self.name = name
        self.rounds = 0
        self._step = step
        self.phases = phases

    async def play(self, phase_s: float) -> None:
        phase_begins_s, due = time.monotonic(), 0.0
        while True:
            for phase in self.phases:
                seen_s, phase_ends_s = phase_begins_s, phase_begins_s + phase_s
                while seen_s < phase_ends_s:
                    now_s = min(time.monotonic(), phase_ends_s)
                    due += (now_s - seen_s) * phase.per_s
                    seen_s = now_s
                    # A flood that is behind leaves out what it cannot send.
                    n = int(due) if phase.per_s <= SLOW_HZ else min(int(due), 64)
                    due -= int(due)
                    self._step(phase, n)
                    await asyncio.sleep(TICK_S)
                phase_begins_s = phase_ends_s
            self.rounds += 1


class RogueDevices(threading.Thread):
    """All devices, in a thread with a separate event loop; use it as a context manager, then `play`.

    Args:
        folder: where ports and sockets are.
        seed: of whatever is random.
    """

    def __init__(self, folder: Path, seed: int) -> None:
        super().__init__(name="rogue devices", daemon=True)
        self.nodes: list[Node] = []
        self.folder = folder
        self.tcp_port = 0
        self.rtu = folder / "rtu"
        self.tty = {name: folder / name for name in ("cobs", "sync", "lines")}
        self._seed = seed
        self._terminals = {name: PseudoTerminal(path) for name, path in self.tty.items()}
        self._buses: dict[str, can.BusABC] = {}
        self._modbus = {name: ModbusRogue(seed + k) for k, name in enumerate(("tcp", "rtu"))}
        self._listening, self._playing, self._over = (threading.Event() for _ in range(3))
        self._phase_s = 1.0
        self._sent = 0

    def __enter__(self) -> Self:
        self.start()
        assert self._listening.wait(PATIENCE_S)
        return self

    def __exit__(self, *_: object) -> None:
        self._over.set()
        self._playing.set()
        self.join(PATIENCE_S)
        assert not self.is_alive()
        for bus in self._buses.values():
            bus.shutdown()
        for terminal in self._terminals.values():
            terminal.unplug()

    @property
    def sound_samples(self) -> int:
        """Samples that the sound device has sent."""
        return self._sent

    def play(self, machine: MachineFile, wanted: Mapping[str, Sequence[Phase]], phase_s: float) -> None:
        """Begin: the sound device, and the rogues that are wanted, each with its phases."""
        self._phase_s = phase_s
        specs = {s: _spec(machine, s) for s in machine.streams}
        layout: FrameLayout = specs["sound"].layout
        self._can("sound", str(self.folder / "can-sound"))
        self._sound = layout
        for k, (name, phases) in enumerate(wanted.items()):
            if name in self._modbus:
                self.nodes.append(Node(name, self._modbus[name].step, phases))
                continue
            spec = specs[name]
            if name == "can":
                self._can(name, str(self.folder / "can-rogue"))
                sequence = RogueFrames(_can_encoder(spec.layout), self._seed + 10 + k)
                step = self._can_step(sequence, spec.layout.frame_id)
            else:
                bus = machine.buses[machine.streams[name].bus]
                assert isinstance(bus, SerialBus)
                framing = framing_of(bus, [spec])
                encode = lambda c, x, f=framing, n=name: f.encode(n, c, x, clip=True)  # noqa: E731
                step = self._serial_step(RogueFrames(encode, self._seed + 10 + k, text=name == "lines"), name)
            self.nodes.append(Node(name, step, phases))
        self._playing.set()

    def run(self) -> None:
        asyncio.run(self._run())

    async def _run(self) -> None:
        tcp = ModbusTcpServer({1: self._modbus["tcp"].unit}, self._modbus["tcp"].plan)
        await tcp.start()
        self.tcp_port = tcp.port
        rtu = ModbusRtuServer({1: self._modbus["rtu"].unit}, self.rtu, self._modbus["rtu"].plan)
        rtu.start()
        self._listening.set()
        await asyncio.to_thread(self._playing.wait)
        playing = [asyncio.create_task(node.play(self._phase_s)) for node in self.nodes]
        if self._buses:
            playing.append(asyncio.create_task(self._play_sound()))
        await asyncio.to_thread(self._over.wait)
        broken = [task.exception() for task in playing if task.done()]
        for task in playing:
            task.cancel()
        await asyncio.gather(*playing, return_exceptions=True)
        tcp.stop()
        rtu.stop()
        assert not broken, broken

    async def _play_sound(self) -> None:
        begun_s = time.monotonic()
        per_frame = self._sound.samples_per_frame
        encode = _can_encoder(self._sound)
        while True:
            due = int((time.monotonic() - begun_s) * 1000.0) // per_frame * per_frame
            if due == self._sent:
                await asyncio.sleep(TICK_S)
                continue
            first = np.arange(self._sent, due, per_frame)
            for data in encode(first, 0.1 * np.ones((len(first), per_frame, 1))):
                self._send("sound", self._sound.frame_id, data)
            self._sent = due
            await asyncio.sleep(TICK_S)

    def _can(self, name: str, path: str) -> None:
        self._buses[name] = can.Bus(interface="unixbus", channel=path, fd=True, receive=False)

    def _send(self, bus: str, frame_id: int, data: bytes) -> None:
        message = can.Message(arbitration_id=frame_id, is_extended_id=False, is_fd=True, data=data)
        self._buses[bus].send(message)

    def _can_step(self, sequence: RogueFrames, frame_id: int) -> Callable[[Phase, int], None]:
        rng = np.random.default_rng(self._seed)

        def step(phase: Phase, n: int) -> None:
            for frame in sequence.frames(phase, n):
                data = frame[
                    : next(
                        size for size in (64, 48, 32, 24, 20, 16, 12, *range(8, -1, -1)) if size <= len(frame)
                    )
                ]
                payloads = (
                    frame_id
                    if phase.values != "noise"
                    else int(rng.choice(np.array([frame_id, rng.integers(2048)])))
                )
                self._send("can", payloads, data)

        return step

    def _serial_step(self, sequence: RogueFrames, name: str) -> Callable[[Phase, int], None]:
        def step(phase: Phase, n: int) -> None:
            # What the other end does not take is gone, as on a wire.
            with contextlib.suppress(BlockingIOError):
                os.write(self._terminals[name].fd, b"".join(sequence.frames(phase, n)))

        return step


def recording(path: Path, layout: FrameLayout, phases: Sequence[Phase], phase_s: float, seed: int) -> None:
    """A candump log of what a rogue CAN device does, with lines and time stamps that cannot be."""
    rng = np.random.default_rng(seed)
    sequence = RogueFrames(_can_encoder(layout), seed)
    lines: list[str] = []
    for k, phase in enumerate(phases):
        n = round(phase_s * phase.per_s)
        for j, frame in enumerate(sequence.frames(phase, n)):
            at_s = 1_640_995_200.0 + k * phase_s + j / phase.per_s
            if phase.damage and rng.random() < 0.05:
                at_s = float(rng.choice([0.0, 9_999_999_999.0, at_s - 1000.0, at_s + 1000.0]))
            lines.append(f"({at_s:.6f}) can0 {layout.frame_id:03X}##0{frame[:64].hex().upper()}")
            if phase.values == "noise":
                lines.append(rng.bytes(20).hex() if rng.random() < 0.5 else "(nan) can0 101#zz")
    path.write_text("\n".join(lines) + "\n", encoding="ascii")


def _can_encoder(layout: FrameLayout) -> Encode:
    return lambda counter, samples: [row.tobytes() for row in layout.encode(counter, samples, clip=True)]


def _spec(machine: MachineFile, stream: str) -> StreamSpec[Any]:
    return StreamSpec(stream, stream_layout(machine, stream), machine.streams[stream].rate_hz)
