"""CAN logs of a machine whose shaft turns as the orbits of `support.orbit_files` do."""

from __future__ import annotations

import gzip
import re
from typing import TYPE_CHECKING, Any

import can
import numpy as np
from support.machine_files import MACHINES
from support.orbit_files import RATE_HZ, SPEED_RPM, Orbit

from daqsvc.settings import load_machine_file
from drivers.can.plugin import frame_layout

if TYPE_CHECKING:
    from collections.abc import Iterable
    from pathlib import Path

    from numpy.typing import NDArray

EPOCH_S = 1_700_000_000.0
"""When the first sample is taken, in s since 1970."""


def machine_file(path: Path, name: str = "rotor-synchronous.toml", rate_hz: float = RATE_HZ) -> Path:
    """An example machine that turns as the orbits do."""
    text = (MACHINES / name).read_text()
    for key, value in {"speed_rpm": SPEED_RPM, "natural_frequency_hz": 60.0, "clearance_um": 200.0}.items():
        text = re.sub(rf"^{key} = [\d.]+", f"{key} = {value}", text, flags=re.MULTILINE)
    text = re.sub(r"^rate_hz = 1600.0", f"rate_hz = {rate_hz}", text, flags=re.MULTILINE)
    path.write_text(text)
    return path


def frames(
    machine: Path,
    stream: str,
    samples: NDArray[np.float64],
    delay_s: float = 0.0,
    channel: str | None = None,
    first: int = 0,
) -> tuple[list[can.Message], NDArray[np.float64]]:
    """The frames that carry samples in the units of the sensors; and the samples as they carry them."""
    layout = frame_layout(load_machine_file(machine), stream)
    rate_hz = load_machine_file(machine).streams[stream].rate_hz
    n = layout.samples_per_frame
    blocks = samples[: len(samples) // n * n].reshape(-1, n, samples.shape[1]).astype(np.float32)
    counters = (first + np.arange(len(blocks)) * n) % 2**16
    payloads: NDArray[Any] = layout.encode(counters, blocks)
    sent = [
        can.Message(
            timestamp=EPOCH_S + delay_s + (first + (k + 1) * n) / rate_hz,
            arbitration_id=layout.frame_id,
            is_extended_id=False,
            is_fd=True,
            channel=channel,
            data=payload.tobytes(),
        )
        for k, payload in enumerate(payloads)
    ]
    return sent, layout.decode(payloads).samples.reshape(-1, samples.shape[1]).astype(float)


def write(path: Path, messages: Iterable[can.Message]) -> Path:
    """Write a log in the format of its suffix."""
    plain = path.with_suffix("") if path.suffix == ".gz" else path
    with can.Logger(plain) as logger:
        for message in messages:
            logger.on_message_received(message)
    if plain != path:
        path.write_bytes(gzip.compress(plain.read_bytes()))
        plain.unlink()
    return path


def signals(orbit: Orbit) -> NDArray[np.float64]:
    """Both probes and the keyphasor, side by side."""
    return np.column_stack([orbit.x, orbit.y, orbit.keyphasor])
