"""A device on a CAN bus that plays samples in time."""

from __future__ import annotations

import asyncio
import errno
import logging
import threading
from dataclasses import dataclass
from typing import TYPE_CHECKING

import can
import numpy as np

from daqsvc.acquisition.clock import NS_PER_S
from sim_hw.node_faults import NodeFaults
from sim_hw.nodes.pacing import LinkLostError, PlannedNode

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from drivers.frames import FrameLayout
    from sim_hw.link_faults import LinkFaults


logger = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class TimedFrames:
    """Frames of one id in the order of time.

    Attributes:
        t_ns: int64 ``[n]``, when the last sample of each frame is taken; sample 0 is taken at 0.
        payloads: uint8 ``[n, length]``.
    """

    t_ns: NDArray[np.int64]
    payloads: NDArray[np.uint8]


def check_samples(
    samples: NDArray[np.float64] | NDArray[np.float32], layout: FrameLayout, rate_hz: float
) -> None:
    """Refuse samples that cannot be put into frames.

    Raises:
        ValueError: as `to_frames`, but for values that do not fit.
    """
    if samples.ndim != 2 or samples.shape[1] != len(layout.channels):
        raise ValueError(
            f"samples are {list(samples.shape)}; frame {layout.frame_id:#x} takes [n, "
            f"{len(layout.channels)}], one column for each of {', '.join(layout.channels)}"
        )
    if rate_hz <= 0:
        raise ValueError(f"rate_hz is {rate_hz}; it must be positive")
    if len(samples) < layout.samples_per_frame:
        raise ValueError(
            f"{len(samples)} samples do not fill one frame {layout.frame_id:#x} of "
            f"{layout.samples_per_frame}; give more"
        )


def to_frames(
    samples: NDArray[np.float64] | NDArray[np.float32],
    layout: FrameLayout,
    rate_hz: float,
    *,
    first_index: int = 0,
    clip: bool = False,
) -> TimedFrames:
    """Put samples into frames; those left over at the end that do not fill a frame stay behind.

    Args:
        samples: ``[n, channels]`` in the layout's physical units, in the order of its channels.
        layout: where the samples go.
        rate_hz: samples per second.
        first_index: the device's sample count at ``samples[0]``.
        clip: saturate values that do not fit, as an analogue input does, instead of raising.

    Raises:
        ValueError: the channels do not match, there is not one whole frame of samples, or a value
            does not fit the layout.
    """
    check_samples(samples, layout, rate_hz)
    per_frame = layout.samples_per_frame
    n = len(samples) // per_frame
    start = np.arange(n, dtype=np.int64) * per_frame
    whole = samples[: n * per_frame].reshape(n, per_frame, -1)
    return TimedFrames(
        t_ns=np.rint((start + per_frame - 1) * (NS_PER_S / rate_hz)).astype(np.int64),
        payloads=layout.encode(first_index + start, whole, clip=clip),
    )


def quantised(
    samples: NDArray[np.float64] | NDArray[np.float32], layout: FrameLayout, *, clip: bool = False
) -> NDArray[np.float32]:
    """Samples as a receiver will see them, after the wire's resolution.

    Args:
        samples: ``[n, channels]`` in the layout's physical units.
        layout: of the frames that would carry them.
        clip: as in `to_frames`.

    Returns:
        float32 ``[m, channels]`` with ``m`` the largest multiple of a frame's samples up to ``n``.

    Raises:
        ValueError: as `to_frames`.
    """
    frames = to_frames(samples, layout, 1.0, clip=clip)
    return layout.decode(frames.payloads).samples.reshape(-1, len(layout.channels))


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
        ValueError: the samples do not fit the layout (`sim_hw.nodes.can_node.to_frames`), or the faults leave
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
        while not await asyncio.to_thread(self._opened, reopen):  # noqa: ASYNC110 - there is no event for it
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
