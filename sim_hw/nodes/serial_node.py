"""A device on a serial cable that plays samples in time."""

from __future__ import annotations

import asyncio
import time
from typing import TYPE_CHECKING

import numpy as np

from sim_hw.link_faults import Fault
from sim_hw.node_faults import NodeFaults

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from drivers.frames import FrameLayout
    from drivers.serial_framing import Framing
    from drivers.serial_lines import LineLayout
    from sim_hw.link_faults import FaultCounts, LinkFaults
    from sim_hw.node_faults_plan import NodePlan
    from sim_hw.nodes.pacing import Pacer
    from sim_hw.nodes.pseudo_terminal import PseudoTerminal

RETRY_S = 0.001
DELIMITER_BYTES = 2
"""No bit of the last bytes of a frame is flipped: without its delimiter a frame would take the next along."""


class SerialNode:
    """Sends samples over a serial cable, each frame at the time its last sample is taken.

    All frames are made, and all faults planned, when the node is: playing only sends. While the
    cable is out, or nobody has the port open, what is sent is gone.

    Args:
        cable: what to send over.
        framing: how frames lie in the stream of bytes.
        stream: name of the stream in ``framing``.
        layout: how samples lie in a frame.
        samples: ``[n, channels]`` in the layout's physical units, in the order of its channels; those left
            over at the end that do not fill a frame are not sent.
        rate_hz: samples per second.
        faults: what goes wrong with the device, or with its link alone; nothing unless given. Nobody else
            is on the cable: there is no babble.
        first_index: the device's sample count at ``samples[0]``.
        clip: saturate values that do not fit the layout, as an analogue input does, instead of raising.
        give_up_s: real seconds for which an open port may take no byte before that is an error.

    Raises:
        ValueError: there is not one whole frame of samples, or they do not fit the layout.
    """

    def __init__(
        self,
        cable: PseudoTerminal,
        framing: Framing,
        stream: str,
        layout: FrameLayout | LineLayout,
        samples: NDArray[np.float64] | NDArray[np.float32],
        rate_hz: float,
        *,
        faults: NodeFaults | LinkFaults | None = None,
        first_index: int = 0,
        clip: bool = False,
        give_up_s: float = 10.0,
    ) -> None:
        self._cable = cable
        self._per_frame = layout.samples_per_frame
        self._give_up_s = give_up_s
        n = len(samples) // self._per_frame
        if n == 0 or samples.ndim != 2 or samples.shape[1] != len(layout.channels):
            raise ValueError(
                f"samples are {list(samples.shape)}; a frame of stream {stream!r} takes {self._per_frame} of "
                f"{', '.join(layout.channels)}"
            )
        if not isinstance(faults, NodeFaults):
            faults = NodeFaults() if faults is None else NodeFaults.of_link(faults)

        def planned(length: int) -> NodePlan:
            return faults.without_babble.plan(
                len(samples),
                rate_hz,
                samples_per_frame=self._per_frame,
                length=length,
                first_index=first_index,
            )

        # First which frames there are; bits are then flipped in what all of them have.
        schedule = planned(1).schedule
        if not len(schedule.sample):
            raise ValueError(f"the faults of stream {stream!r} leave no frame of it; end a brown-out earlier")
        rows = schedule.sample[:, None] + np.arange(self._per_frame)
        frames = framing.encode(stream, schedule.count, samples[rows], clip=clip)
        self._plan = planned(min(map(len, frames)) - DELIMITER_BYTES)
        self._frames = [
            _flipped(frames[frame], flips) if fault == Fault.CORRUPTED else frames[frame]
            for frame, fault, flips in zip(
                self._plan.frame.tolist(), self._plan.fault.tolist(), self._plan.flips, strict=True
            )
        ]
        self._played = 0
        self._retries = 0
        self._unheard = 0

    @property
    def injected(self) -> FaultCounts:
        """Frames played so far, and the faults that were really done to them."""
        return self._plan.injected(self._played)

    @property
    def samples_sent(self) -> int:
        """Samples, per channel, that were played so far, whatever became of them."""
        return self.injected.frames_in * self._per_frame

    @property
    def frames_unheard(self) -> int:
        """Frames that were sent while the cable was out or nobody had the port open."""
        return self._unheard

    @property
    def send_retries(self) -> int:
        """How often the cable had no room for a frame and it was offered again."""
        return self._retries

    @property
    def duration_ns(self) -> int:
        """Simulated time from the first sample to the last frame."""
        return int(self._plan.t_ns[-1])

    async def play(self, pacer: Pacer) -> None:
        """Send everything, as the pacer lets time pass.

        Raises:
            TimeoutError: the port is open and has taken no byte for ``give_up_s``.
        """
        plan = zip(self._plan.t_ns.tolist(), self._plan.sends.tolist(), strict=True)
        for k, (t_ns, sends) in enumerate(plan):
            await pacer.wait_until(t_ns)
            if sends:
                await self._send(self._frames[k])
            self._played = k + 1
        # A pseudo-terminal does not tell when it has room again.
        while self._cable.listening and not self._cable.flush():  # noqa: ASYNC110
            await asyncio.sleep(RETRY_S)

    async def _send(self, frame: bytes) -> None:
        refused_since: float | None = None
        while not self._cable.send(frame):
            if not self._cable.listening:
                self._unheard += 1
                return
            now = time.monotonic()
            refused_since = now if refused_since is None else refused_since
            if now - refused_since > self._give_up_s:
                raise TimeoutError(
                    f"{self._cable.path} has taken no byte for {self._give_up_s:g} s although it is open; "
                    "whoever has it open has stopped reading"
                )
            self._retries += 1
            await asyncio.sleep(RETRY_S)


def _flipped(frame: bytes, flips: NDArray[np.uint8]) -> bytes:
    spoilt = np.frombuffer(frame, np.uint8).copy()
    spoilt[: len(flips)] ^= flips
    return spoilt.tobytes()
