"""Serial devices, and their cable without a UART: a pseudo-terminal whose path outlives being re-plugged."""

from __future__ import annotations

import asyncio
import contextlib
import errno
import os
import select
import termios
import tty
from typing import TYPE_CHECKING

import numpy as np

from drivers.frames import FrameLayout
from sim_hw.link_faults import Fault
from sim_hw.node_faults import NodeFaults
from sim_hw.nodes.pacing import RETRY_S, LinkLostError, PlannedNode

if TYPE_CHECKING:
    from pathlib import Path
    from types import TracebackType
    from typing import Self

    from numpy.typing import NDArray

    from drivers.serial.framing import Framing
    from drivers.serial.settings import LineLayout
    from sim_hw.link_faults import LinkFaults
    from sim_hw.node_faults import NodePlan
    from sim_hw.nodes.pacing import Pacer


class PseudoTerminal:
    """The device's end of a serial cable; whoever opens ``path`` has the other end.

    A pseudo-terminal passes bytes at memory speed whatever its baud rate, has no parity and no modem lines.
    Unplugging it takes the unread bytes along, as a USB adapter does, and removes ``path``; plugging it in
    makes a new device behind the same path.

    Args:
        path: of the symbolic link to the port, as udev makes them below ``/dev/serial/by-id``.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._fd: int | None = None
        self._unsent = b""
        self.plug()

    @property
    def plugged(self) -> bool:
        """Whether the cable is there."""
        return self._fd is not None

    @property
    def fd(self) -> int:
        """File descriptor of the device's end.

        Raises:
            OSError: the cable is unplugged.
        """
        if self._fd is None:
            raise OSError(errno.ENODEV, f"{self.path} is unplugged; plug it in before using it")
        return self._fd

    def plug(self) -> None:
        """Plug the cable in; nothing happens if it is."""
        if self._fd is not None:
            return
        device, port = os.openpty()
        tty.setraw(port, termios.TCSANOW)
        os.set_blocking(device, False)
        temporary = self.path.with_name(f"{self.path.name}.new")
        temporary.unlink(missing_ok=True)
        temporary.symlink_to(os.ttyname(port))
        temporary.replace(self.path)
        # Nobody holds the port open on our side: when the reader closes it, it is closed.
        os.close(port)
        self._fd, self._unsent = device, b""

    def unplug(self) -> None:
        """Pull the cable out; nothing happens if it is out."""
        if self._fd is None:
            return
        self.path.unlink(missing_ok=True)
        os.close(self._fd)
        self._fd = None

    @property
    def pending(self) -> bool:
        """Whether a part of a frame still waits for room; `flush` sends it."""
        return bool(self._unsent)

    @property
    def listening(self) -> bool:
        """Whether somebody has the other end open."""
        if self._fd is None:
            return False
        poll = select.poll()
        poll.register(self._fd, 0)
        return not any(events & select.POLLHUP for _, events in poll.poll(0))

    def send(self, frame: bytes) -> bool:
        """Put one frame on the wire. One that finds room in part is finished by the next calls.

        Returns:
            False if the port is not open, or the other end has not read enough for the frame to find room.
        """
        if not self.listening:
            self._unsent = b""
            return False
        if not self.flush():
            return False
        self._unsent = frame
        self.flush()
        if len(self._unsent) == len(frame):
            self._unsent = b""
            return False
        return True

    def flush(self) -> bool:
        """Send what is left of a frame that found room in part; returns whether nothing is left."""
        with contextlib.suppress(BlockingIOError):
            while self._unsent:
                self._unsent = self._unsent[os.write(self.fd, self._unsent) :]
        return not self._unsent

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.unplug()


DELIMITER_BYTES = 2
"""No bit of the last bytes of a frame is flipped: without its delimiter a frame would take the next along."""


class SerialNode(PlannedNode):
    """Sends samples over a serial cable, each frame at the time its last sample is taken.

    All frames are made, and all faults planned, when the node is: playing only sends. While the
    cable is out, or the port is not open, what is sent is gone.

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
        per_frame = layout.samples_per_frame
        channels = layout.channels if isinstance(layout, FrameLayout) else layout.channel_names
        n = len(samples) // per_frame
        if n == 0 or samples.ndim != 2 or samples.shape[1] != len(channels):
            raise ValueError(
                f"samples are {list(samples.shape)}; a frame of stream {stream!r} takes {per_frame} of "
                f"{', '.join(channels)}"
            )
        own_faults = NodeFaults.of(faults).without_babble

        def planned(length: int) -> NodePlan:
            return own_faults.plan(
                len(samples),
                rate_hz,
                samples_per_frame=per_frame,
                length=length,
                first_index=first_index,
            )

        # First which frames there are; bits are then flipped in what all of them have.
        schedule = planned(1).schedule
        if not len(schedule.sample):
            raise ValueError(f"the faults of stream {stream!r} leave no frame of it; end a brown-out earlier")
        rows = schedule.sample[:, None] + np.arange(per_frame)
        frames = framing.encode(stream, schedule.count, samples[rows], clip=clip)
        plan = planned(min(map(len, frames)) - DELIMITER_BYTES)
        super().__init__(plan, per_frame, give_up_s)
        self._cable = cable
        self._sends = plan.sends.tolist()
        self._frames = [
            _flipped(frames[frame], flips) if fault == Fault.CORRUPTED else frames[frame]
            for frame, fault, flips in zip(plan.frame.tolist(), plan.fault.tolist(), plan.flips, strict=True)
        ]

    async def play(self, pacer: Pacer) -> None:
        """See `PlannedNode.play`; returns when all that was sent has gone, or the port is not open."""
        await super().play(pacer)
        # A pseudo-terminal does not report when it has room again.
        while self._cable.listening and not self._cable.flush():  # noqa: ASYNC110
            await asyncio.sleep(RETRY_S)

    async def _do(self, event: int) -> None:
        if self._sends[event]:
            self._unsent += not await self._offer(lambda: self._refusal(self._frames[event]))

    def _refusal(self, frame: bytes) -> str:
        """Why the cable does not take a frame for now; nothing if it does."""
        if self._cable.send(frame):
            return ""
        if not self._cable.listening:
            raise LinkLostError
        return (
            f"{self._cable.path} has taken no byte for {self._give_up_s:g} s although it is open; "
            "whoever has it open has stopped reading"
        )


def _flipped(frame: bytes, flips: NDArray[np.uint8]) -> bytes:
    spoilt = np.frombuffer(frame, np.uint8).copy()
    spoilt[: len(flips)] ^= flips
    return spoilt.tobytes()
