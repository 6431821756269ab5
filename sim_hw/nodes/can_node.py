"""A device on a CAN bus that plays samples in time."""

from __future__ import annotations

import asyncio
import errno
import logging
import threading
from typing import TYPE_CHECKING

import can
import numpy as np

from sim_hw.node_faults import NodeFaults
from sim_hw.nodes.planned_node import LinkLostError, PlannedNode
from sim_hw.nodes.wire import check_samples

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from drivers.frames import FrameLayout
    from sim_hw.link_faults import LinkFaults

logger = logging.getLogger(__name__)

REOPEN_S = 0.02
"""Between attempts to open a bus that was lost."""


class CanNode(PlannedNode):
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
        self._reopen = reopen
        self._opening: asyncio.Task[None] | None = None
        self._changing = threading.Lock()
        self._lost = self._closed = False
        plan = NodeFaults.of(faults).plan(
            len(samples),
            rate_hz,
            samples_per_frame=layout.samples_per_frame,
            length=layout.length,
            first_index=first_index,
        )
        schedule = plan.schedule
        if not len(schedule.sample):
            raise ValueError(
                f"the faults of frame {layout.frame_id:#x} leave none of it: the node is off all the time; "
                "end a brown-out earlier, or give more samples"
            )
        rows = schedule.sample[:, None] + np.arange(layout.samples_per_frame)
        payloads = layout.encode(schedule.count, samples[rows], clip=clip)
        super().__init__(plan, layout.samples_per_frame, give_up_s)
        self._payloads = (payloads[plan.frame] ^ plan.flips).tobytes()
        self._sends, self._babble_id = plan.sends.tolist(), plan.babble_id.tolist()

    async def _do(self, event: int) -> None:
        if self._babble_id[event] >= 0:
            await self._send(
                can.Message(arbitration_id=self._babble_id[event], is_extended_id=False, check=False)
            )
        elif self._sends[event]:
            length = self._layout.length
            payload = self._payloads[event * length : (event + 1) * length]
            self._unsent += not await self._send(self._message(payload))

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
        if self._opening is not None:
            if not self._opening.done():
                return False
            self._opening.result()
        if await self._offer(lambda: self._refusal(message)):
            self._lost = False
            return True
        if self._reopen is not None:
            # In the background: the device goes on sampling, and what is due meanwhile is gone.
            self._opening = asyncio.create_task(self._open_again(self._reopen), name="CAN node's bus")
        return False

    def _refusal(self, message: can.Message) -> str:
        """Why the bus does not take a frame for now; nothing if it does."""
        try:
            self._bus.send(message, timeout=0)
        except can.CanOperationError as error:
            # A full queue (ENOBUFS) empties by itself.
            if self._reopen is not None and error.error_code != errno.ENOBUFS:
                self._tell_lost(error)
                raise LinkLostError from error
            return (
                f"{self._bus.channel_info} has refused frame {message.arbitration_id:#x} for "
                f"{self._give_up_s:g} s ({error}); is the interface up, and does anyone acknowledge?"
            )
        return ""

    def _tell_lost(self, error: can.CanOperationError) -> None:
        if not self._lost:
            logger.warning(
                "%s is lost to the node of frame %#x (%s); what it sends until the bus is back is gone",
                self._bus.channel_info,
                self._layout.frame_id,
                error,
            )
        self._lost = True

    async def _open_again(self, reopen: Callable[[], can.BusABC]) -> None:
        while not await asyncio.to_thread(self._opened, reopen):  # noqa: ASYNC110 - nothing tells of it
            await asyncio.sleep(REOPEN_S)

    def _opened(self, reopen: Callable[[], can.BusABC]) -> bool:
        """Open the bus again; whether there is one. Not from the event loop: that may take long."""
        try:
            bus = reopen()
        except (can.CanError, OSError) as error:
            logger.debug("the bus cannot be opened again yet: %s", error)
            return False
        with self._changing:
            # Whoever has closed the node meanwhile does not know of this one.
            old, self._bus = (bus, self._bus) if self._closed else (self._bus, bus)
        old.shutdown()
        return True

    def close(self) -> None:
        """Shut down the bus that the node has now, which is not the first one if that was lost."""
        if self._opening is not None:
            self._opening.cancel()
        with self._changing:
            self._closed = True
        self._bus.shutdown()
