"""A device on a CAN bus that plays samples in time."""

from __future__ import annotations

import asyncio
import time
from typing import TYPE_CHECKING

import can
import numpy as np

from sim_hw.link_faults import Fault, FaultCounts
from sim_hw.nodes.wire import to_frames

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from drivers.frames import FrameLayout
    from sim_hw.link_faults import LinkFaults
    from sim_hw.nodes.pacing import Pacer

RETRY_S = 0.002


class CanNode:
    """Sends samples over a bus, each frame at the time its last sample is taken.

    All frames are made, and all faults of the link planned, when the node is: playing only sends.

    Args:
        bus: an open bus of python-can.
        layout: how samples lie in a frame.
        samples: ``[n, channels]`` in the layout's physical units, in the order of its channels.
        rate_hz: samples per second.
        faults: what the link does to the frames; nothing unless given.
        first_index: the device's sample count at ``samples[0]``.
        clip: saturate values that do not fit the layout, as an analogue input does, instead of raising.
        give_up_s: real seconds for which a bus may refuse a frame before that is an error.

    Raises:
        ValueError: the samples do not fit the layout (`sim_hw.nodes.wire.to_frames`).
    """

    def __init__(
        self,
        bus: can.BusABC,
        layout: FrameLayout,
        samples: NDArray[np.float64] | NDArray[np.float32],
        rate_hz: float,
        *,
        faults: LinkFaults | None = None,
        first_index: int = 0,
        clip: bool = False,
        give_up_s: float = 10.0,
    ) -> None:
        self._bus = bus
        self._layout = layout
        self._give_up_s = give_up_s
        frames = to_frames(samples, layout, rate_hz, first_index=first_index, clip=clip)
        if faults is None:
            self._t_ns, self._payloads = frames.t_ns, frames.payloads
            self._faults = np.zeros(len(frames.t_ns), np.uint8)
        else:
            plan = faults.plan(frames.t_ns, layout.length)
            self._t_ns, self._payloads = plan.t_ns, frames.payloads[plan.frame] ^ plan.flips
            self._faults = plan.fault
        # Asked for at every step of a paced run, so counted once.
        self._frames_done = np.concatenate(([0], np.cumsum(self._faults != Fault.DUPLICATED))).tolist()
        self._played = 0
        self._retries = 0

    @property
    def injected(self) -> FaultCounts:
        """Frames played so far, and the faults that were really done to them."""
        return FaultCounts.of(self._faults[: self._played])

    @property
    def frames_sent(self) -> int:
        """Frames handed to the bus so far, second copies and corrupted ones included."""
        done = self.injected
        return done.frames_in - done.dropped + done.duplicated

    @property
    def samples_sent(self) -> int:
        """Samples, per channel, that were played so far, whatever the link did to them."""
        frames: int = self._frames_done[self._played]
        return frames * self._layout.samples_per_frame

    @property
    def send_retries(self) -> int:
        """How often the bus refused a frame (its queue was full) and it was offered again."""
        return self._retries

    @property
    def duration_ns(self) -> int:
        """Simulated time from the first sample to the last frame."""
        return int(self._t_ns[-1])

    async def play(self, pacer: Pacer) -> None:
        """Send everything, as the pacer lets time pass.

        Raises:
            TimeoutError: the bus refused a frame for ``give_up_s``.
        """
        payloads = self._payloads.tobytes()
        length = self._layout.length
        for i, (t_ns, fault) in enumerate(zip(self._t_ns.tolist(), self._faults.tolist(), strict=True)):
            await pacer.wait_until(t_ns)
            if fault != Fault.DROPPED:
                await self._send(payloads[i * length : (i + 1) * length])
            self._played = i + 1

    async def _send(self, payload: bytes) -> None:
        message = can.Message(
            arbitration_id=self._layout.frame_id,
            is_extended_id=self._layout.extended,
            is_fd=self._layout.fd,
            bitrate_switch=self._layout.fd,
            data=payload,
            check=False,
        )
        refused_since: float | None = None
        while True:
            try:
                self._bus.send(message, timeout=0)
            except can.CanOperationError as error:
                # A full queue (ENOBUFS) empties by itself.
                now = time.monotonic()
                refused_since = now if refused_since is None else refused_since
                if now - refused_since > self._give_up_s:
                    raise TimeoutError(
                        f"{self._bus.channel_info} has refused frame {self._layout.frame_id:#x} for "
                        f"{self._give_up_s:g} s ({error}); is the interface up, and does anyone acknowledge?"
                    ) from error
                self._retries += 1
                await asyncio.sleep(RETRY_S)
            else:
                return
