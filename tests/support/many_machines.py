"""Paper rotors on a few CAN buses, watched by a service in one process and fed in real time by another.

Each has two probes and a keyphasor at 640 Hz, levels and a bank of ten models. A bus has eight of them.
"""

from __future__ import annotations

import contextlib
import json
import math
import os
import re
import signal
import socket
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from support.can_standin import frames_bytes
from support.paths import ROOT

from daqsvc.control import SOCKET, ControlError, ask_status
from daqsvc.settings import parse_machine_file
from drivers.can.plugin import frame_layout
from sim_hw.nodes.can_node import to_frames

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from numpy.typing import NDArray

    from drivers.frames import FrameLayout

PER_BUS = 8
RATE_HZ = 640.0
SAMPLES_PER_FRAME = 10
START_S = 120.0
"""What the service may take to start, on a host that does other things as well."""
ARRIVE_S = 2.0
"""What the last samples may take to come to the detectors."""
_FIRST_ID = 0x100
_LEFT_OUT = ("L3", "K2")
"""Of the twelve modes of the example."""


class Sent(NamedTuple):
    """What the devices have sent.

    Attributes:
        samples: by machine, those that the bus has taken.
        refused: frames that it has not, since nobody read it for so long.
    """

    samples: list[int]
    refused: int


class Watched:
    """A service that watches many machines.

    Args:
        process: its process.
        store: directory of its journal.
        sender: the process of the devices.
    """

    def __init__(
        self, process: subprocess.Popen[bytes], store: Path, sender: subprocess.Popen[bytes]
    ) -> None:
        self._process = process
        self._store = store
        self._sender = sender

    def cpu_s(self) -> float:
        """Processor time that the service has taken so far, all threads, in the kernel and outside."""
        # MAKE_PROCESS_CPUCLOCK(pid, CPUCLOCK_SCHED) of clock_getcpuclockid(3)
        return time.clock_gettime(~self._process.pid << 3 | 2)

    def resident_mb(self) -> float:
        """Memory of the service that is in RAM, shared libraries included."""
        text = (self._proc / "smaps_rollup").read_text()
        return 1.024e-3 * int(text.partition("\nRss:")[2].split()[0])

    def threads(self) -> int:
        """Threads of the service."""
        return len(list((self._proc / "task").iterdir()))

    def descriptors(self) -> int:
        """Open files of the service."""
        return len(list((self._proc / "fd").iterdir()))

    def status(self, machine: int) -> dict[str, object]:
        """How a machine stands."""
        [status] = ask_status(self._store, name_of(machine))
        return status

    def kill(self) -> None:
        """End the service as a power cut does: kill -9."""
        self._process.kill()
        self._process.wait()

    def silence(self) -> Sent:
        """End the devices, and wait until what they have sent has come to the detectors."""
        self._sender.send_signal(signal.SIGTERM)
        out, _ = self._sender.communicate(timeout=START_S)
        time.sleep(ARRIVE_S)
        return Sent(**json.loads(out))

    @property
    def _proc(self) -> Path:
        return Path(f"/proc/{self._process.pid}")


def name_of(machine: int) -> str:
    """What a machine is called, by its number."""
    return f"rotor-{machine:02}"


def rotor_text(machine: int, store: Path, more: str = "") -> str:
    """The machine file of a rotor."""
    text = (ROOT / "config" / "machines" / "laval-rig-twelve-modes.toml").read_text()
    text = re.sub(r"(?ms)^\[mqtt\].*?(?=^\[store\])", "", text)
    for mode in _LEFT_OUT:
        text = re.sub(rf'(?m)^  \{{ name = "{mode}".*\n', "", text)
    for old, new in (
        ('name = "laval-rig-12"', f'name = "{name_of(machine)}"'),
        ("0x101", f"{_FIRST_ID + machine:#x}"),
        ("can0", f"can{machine // PER_BUS}"),
        ("/var/lib/daqsvc", str(store)),
    ):
        assert old in text, old
        text = text.replace(old, new)
    return text + more


@contextlib.contextmanager
def watched(folder: Path, machines: int, *, core: int | None = None, more: str = "") -> Iterator[Watched]:
    """A service that watches so many machines, which have begun to send.

    Args:
        folder: an empty directory.
        machines: how many.
        core: the only processor that the service may run on; None for any.
        more: tables to add to each machine file.
    """
    plant, store = folder / "plant", folder / "store"
    plant.mkdir()
    for machine in range(machines):
        (plant / f"{name_of(machine)}.toml").write_text(rotor_text(machine, store, more))
    buses = [f"can{n}" for n in range(math.ceil(machines / PER_BUS))]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), str(ROOT / "tests")])}
    with contextlib.ExitStack() as stack:
        pairs = [socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET) for _ in buses]
        for end in (end for pair in pairs for end in pair):
            stack.enter_context(end)
        wires = {bus: there.fileno() for bus, (_, there) in zip(buses, pairs, strict=True)}
        devices = [here.fileno() for here, _ in pairs]
        log = stack.enter_context((folder / "log").open("wb"))

        def start(command: Sequence[str], descriptors: Sequence[int]) -> subprocess.Popen[bytes]:
            process = subprocess.Popen(
                [sys.executable, "-m", *command],
                pass_fds=descriptors,
                env=environment,
                stdout=subprocess.PIPE,
                stderr=log,
            )
            stack.callback(_end, process)
            return process

        service = start(("support.wired_service", json.dumps(wires), "run", str(plant)), list(wires.values()))
        if core is not None:
            os.sched_setaffinity(service.pid, {core})
        _wait_for(service, store, folder / "log")
        numbers = [f"{number}" for number in (machines, *devices)]
        sender = start(("support.many_machines", *numbers), devices)
        yield Watched(service, store, sender)


def _wait_for(service: subprocess.Popen[bytes], store: Path, log: Path) -> None:
    until_s = time.monotonic() + START_S
    while time.monotonic() < until_s and service.poll() is None:
        if (store / SOCKET).exists():
            with contextlib.suppress(ControlError):
                ask_status(store, name_of(0))
                return
        time.sleep(0.1)
    raise AssertionError(f"the service does not start: {log.read_text()}")


def _end(process: subprocess.Popen[bytes]) -> None:
    process.terminate()
    try:
        process.communicate(timeout=10.0)
    except subprocess.TimeoutExpired:
        process.kill()
        process.communicate()


def healthy_payloads(layout: FrameLayout, rate_hz: float) -> NDArray[np.uint8]:
    """Frames of the healthy rotor of the examples, until the counter of samples is at 0 at a beginning again.

    Args:
        layout: of its frames, ten samples of three channels in each.
        rate_hz: of the samples.
    """
    n = 5 * 2**16
    turns = np.arange(n) * 600.0 / 60.0 / rate_hz
    orbit_um = 27.8 * np.exp(2j * math.pi * (turns - 0.25)) - 10j
    noise_um = np.random.default_rng(0).normal(0.0, 2.0, (n, 2))
    probes_um = np.column_stack((orbit_um.real, orbit_um.imag)) + noise_um
    samples = np.column_stack((probes_um, np.where(turns % 1.0 < 0.1, -2.0, -10.0)))
    return to_frames(samples, layout, rate_hz).payloads


def send(machines: int, descriptors: Sequence[int]) -> None:
    """The devices: each sends its frames when they are due, those of a bus by turns, until SIGTERM."""
    stopped = []
    signal.signal(signal.SIGTERM, lambda *_: stopped.append(True))
    layout = frame_layout(parse_machine_file(rotor_text(0, Path("store")), ROOT / "rotor.toml"), "shaft")
    bodies = [frame[4:] for frame in frames_bytes(0, healthy_payloads(layout, RATE_HZ))]
    words = [(_FIRST_ID + machine).to_bytes(4, "little") for machine in range(machines)]
    for descriptor in descriptors:
        os.set_blocking(descriptor, False)
    samples, refused = Counter(dict.fromkeys(range(machines), 0)), 0
    slot_s = SAMPLES_PER_FRAME / RATE_HZ / PER_BUS
    begun_s, slot = time.monotonic(), 0
    while not stopped:
        if (early_s := begun_s + slot * slot_s - time.monotonic()) > 0.0:
            time.sleep(early_s)
        frame, place = divmod(slot, PER_BUS)
        body = bodies[frame % len(bodies)]
        for machine in range(place, machines, PER_BUS):
            try:
                os.write(descriptors[machine // PER_BUS], words[machine] + body)
                samples[machine] += SAMPLES_PER_FRAME
            except BlockingIOError:
                refused += 1
        slot += 1
    print(json.dumps({"samples": [samples[machine] for machine in range(machines)], "refused": refused}))  # noqa: T201


if __name__ == "__main__":
    send(int(sys.argv[1]), [int(number) for number in sys.argv[2:]])
