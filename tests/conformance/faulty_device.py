"""The bookkeeping of a conformance device: which of its frames reach the wire, how often, in what order."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

REFUSED_FRAMES = 500


class FaultyDevice(ABC):
    """A `conformance.transport.Device` but for the wire: a transport adds how one frame is put on it.

    Args:
        samples_per_frame: samples of each channel in a frame.
    """

    def __init__(self, samples_per_frame: int) -> None:
        self.frames_on_wire = 0
        self.samples_on_wire = 0
        self.present = True
        self._per_frame = samples_per_frame
        self._silent = False
        self._dropping = 0
        self._duplicating = False
        self._reordering = False
        self._corrupting = False
        self._resetting = False
        self._held: tuple[int, NDArray[np.float32]] | None = None
        self._counted_from = 0
        self._refused = 0

    @abstractmethod
    def put(self, first_index: int, samples: NDArray[np.float32], *, corrupt: bool) -> bool:
        """Put one frame on the wire; tells whether the wire has taken it. Made by the transport."""

    async def send(self, first_index: int, samples: NDArray[np.float32]) -> None:
        """See `Device.send`."""
        self.flood(first_index, samples)

    def flood(self, first_index: int, samples: NDArray[np.float32]) -> None:
        """See `Device.flood`.

        It ends once the wire has refused many: where a thread empties the wire meanwhile, it would else
        take more the slower the computer is, and in the end as many as no backlog can hold.
        """
        self._refused = 0
        for at in range(0, len(samples), self._per_frame):
            if self._refused >= REFUSED_FRAMES:
                return
            self._pass_on(first_index + at, samples[at : at + self._per_frame])

    def drop(self, frames: int = 1) -> None:
        """See `Device.drop`."""
        self._dropping = frames

    def duplicate(self) -> None:
        """See `Device.duplicate`."""
        self._duplicating = True

    def reorder(self) -> None:
        """See `Device.reorder`."""
        self._reordering = True

    def corrupt(self) -> None:
        """See `Device.corrupt`."""
        self._corrupting = True

    def reset_counter(self) -> None:
        """See `Device.reset_counter`."""
        self._resetting = True

    def silence(self) -> None:
        """See `Device.silence`."""
        self._silent = True

    def speak(self) -> None:
        """See `Device.speak`."""
        self._silent = False

    def go_away(self) -> None:
        """See `Device.go_away`."""
        self.present = False

    def come_back(self) -> None:
        """See `Device.come_back`."""
        self.present = True

    def _pass_on(self, index: int, samples: NDArray[np.float32]) -> None:
        if self._resetting:
            self._resetting = False
            self._counted_from = index
        index -= self._counted_from
        if self._silent or not self.present:
            return
        if self._dropping:
            self._dropping -= 1
        elif self._reordering:
            self._reordering = False
            self._held = (index, samples)
        else:
            self._put(index, samples)
            if self._held is not None:
                held, self._held = self._held, None
                self._put(*held)

    def _put(self, index: int, samples: NDArray[np.float32]) -> None:
        corrupt, self._corrupting = self._corrupting, False
        taken = self.put(index, samples, corrupt=corrupt)
        self._refused += not taken
        self.frames_on_wire += taken
        self.samples_on_wire += len(samples) if taken and not corrupt else 0
        if self._duplicating:
            self._duplicating = False
            self.frames_on_wire += self.put(index, samples, corrupt=False)
