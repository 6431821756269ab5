"""A device on a CAN bus that plays samples in time."""

from __future__ import annotations

import asyncio
import errno
import logging
import time
from typing import TYPE_CHECKING

import can
import numpy as np

from sim_hw.link_faults import Fault
from sim_hw.node_faults import NodeFaults
from sim_hw.nodes.wire import check_samples

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from drivers.frames import FrameLayout
    from sim_hw.link_faults import FaultCounts, LinkFaults
    from sim_hw.nodes.pacing import Pacer

logger = logging.getLogger(__name__)

RETRY_S = 0.002


class CanNode:
    """Sends samples over a bus, each frame at the time its last sample is taken.

    All frames are made, and all faults planned, when the node is: playing only sends.

    Args:
        bus: an open bus of python-can.
        layout: how samples lie in a frame.
        samples: ``[n, channels]`` in the layout's physical units, in the order of its channels.
        rate_hz: samples per second.
        faults: what goes wrong with the node, or with its link alone; nothing unless given.
        first_index: the device's sample count at ``samples[0]``.
        clip: saturate values that do not fit the layout, as an analogue input does, instead of raising.
        give_up_s: real seconds for which a bus may refuse a frame before that is an error.
        reopen: opens the bus again after it was lost; frames are lost meanwhile, as a device's are. Unless
            given, a bus that is lost is one that refuses.

    Raises:
        ValueError: the samples do not fit the layout (`sim_hw.nodes.wire.to_frames`), or the faults leave
            no frame of them.
    """

    def __init__(
        self,
        bus: can.BusABC,
        layout: FrameLayout,
        samples: NDArray[np.float64] | NDArray[np.float32],
        rate_hz: float,
        *,
        faults: NodeFaults | LinkFaults | None = None,
        first_index: int = 0,
        clip: bool = False,
        give_up_s: float = 10.0,
        reopen: Callable[[], can.BusABC] | None = None,
    ) -> None:
        check_samples(samples, layout, rate_hz)
        self._bus = bus
        self._layout = layout
        self._give_up_s = give_up_s
        self._reopen = reopen
        if not isinstance(faults, NodeFaults):
            faults = NodeFaults() if faults is None else NodeFaults.of_link(faults)
        self._plan = faults.plan(
            len(samples),
            rate_hz,
            samples_per_frame=layout.samples_per_frame,
            length=layout.length,
            first_index=first_index,
        )
        schedule = self._plan.schedule
        if not len(schedule.sample):
            raise ValueError(
                f"the faults of frame {layout.frame_id:#x} leave none of it: the node is off all the time; "
                "end a brown-out earlier, or give more samples"
            )
        rows = schedule.sample[:, None] + np.arange(layout.samples_per_frame)
        payloads = layout.encode(schedule.count, samples[rows], clip=clip)
        self._payloads = payloads[self._plan.frame] ^ self._plan.flips
        # Asked for at every step of a paced run, so counted once.
        makes_frame = (self._plan.fault != Fault.DUPLICATED) & (self._plan.fault != Fault.BABBLED)
        self._frames_done = np.concatenate(([0], np.cumsum(makes_frame))).tolist()
        self._played = 0
        self._retries = 0
        self._unsent = 0

    @property
    def injected(self) -> FaultCounts:
        """Frames played so far, and the faults that were really done to them."""
        return self._plan.injected(self._played)

    @property
    def frames_sent(self) -> int:
        """Frames handed to the bus so far, second copies and corrupted ones included."""
        return self.injected.sent - self._unsent

    @property
    def frames_unsent(self) -> int:
        """Frames that were lost because the bus was."""
        return self._unsent

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
        return int(self._plan.t_ns[-1])

    async def play(self, pacer: Pacer) -> None:
        """Send everything, as the pacer lets time pass.

        Raises:
            TimeoutError: the bus refused a frame for ``give_up_s``.
        """
        payloads = self._payloads.tobytes()
        length = self._layout.length
        plan = zip(
            self._plan.t_ns.tolist(), self._plan.sends.tolist(), self._plan.babble_id.tolist(), strict=True
        )
        for i, (t_ns, sends, babble_id) in enumerate(plan):
            await pacer.wait_until(t_ns)
            if babble_id >= 0:
                await self._send(can.Message(arbitration_id=babble_id, is_extended_id=False, check=False))
            elif sends:
                sent = await self._send(self._message(payloads[i * length : (i + 1) * length]))
                self._unsent += not sent
            self._played = i + 1

    def _message(self, payload: bytes) -> can.Message:
        return can.Message(
            arbitration_id=self._layout.frame_id,
            is_extended_id=self._layout.extended,
            is_fd=self._layout.fd,
            bitrate_switch=self._layout.fd,
            data=payload,
            check=False,
        )

    async def _send(self, message: can.Message) -> bool:
        """Put a frame on the bus; False if the bus is lost, and the frame with it."""
        refused_since: float | None = None
        while True:
            try:
                self._bus.send(message, timeout=0)
            except can.CanOperationError as error:
                if self._reopen is not None and error.error_code != errno.ENOBUFS:
                    await self._open_again(self._reopen)
                    return False
                # A full queue (ENOBUFS) empties by itself.
                now = time.monotonic()
                refused_since = now if refused_since is None else refused_since
                if now - refused_since > self._give_up_s:
                    raise TimeoutError(
                        f"{self._bus.channel_info} has refused frame {message.arbitration_id:#x} for "
                        f"{self._give_up_s:g} s ({error}); is the interface up, and does anyone acknowledge?"
                    ) from error
                self._retries += 1
                await asyncio.sleep(RETRY_S)
            else:
                return True

    async def _open_again(self, reopen: Callable[[], can.BusABC]) -> None:
        try:
            bus = await asyncio.to_thread(reopen)
        except (can.CanError, OSError) as error:
            logger.debug("the bus cannot be opened again yet: %s", error)
            return
        self._bus.shutdown()
        self._bus = bus

    def close(self) -> None:
        """Shut down the bus that the node has now, which is not the first one if that was lost."""
        self._bus.shutdown()
