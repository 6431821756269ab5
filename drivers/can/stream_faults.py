"""Why no samples of a stream come although its bus is up: what comes instead of its frames."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

from daqsvc.acquisition.clock import NS_PER_S

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from daqsvc.acquisition.clock import Clock
    from drivers.base import StreamSpec
    from drivers.frames import FrameLayout

RECENT_NS = 10 * NS_PER_S
"""Time for which frames of other ids count as coming."""
MOST_NAMED = 5


class StreamFaults(Mapping[str, str]):
    """By stream, what comes in place of its frames, in a clause: the `faults` of a `Link`.

    Args:
        bus: its name.
        specs: the streams on it.
        clock: the service's clock.
    """

    def __init__(self, bus: str, specs: Sequence[StreamSpec[FrameLayout]], clock: Clock) -> None:
        self._bus = bus
        self._specs = {spec.name: spec for spec in specs}
        self._clock = clock
        self._others_ns: dict[str, int] = {}
        self._wrong_length: dict[str, int] = {}

    def heard(self, stream: str) -> None:
        """Frames of a stream have come that can be read."""
        self._wrong_length.pop(stream, None)

    def heard_other(self, frame_id: str) -> None:
        """Frames have come that no stream has; their id in words."""
        self._others_ns[frame_id] = self._clock.monotonic_ns()

    def has_wrong_length(self, stream: str, length: int) -> None:
        """Frames with the id of a stream have come, of another length in bytes."""
        self._wrong_length[stream] = length

    def __getitem__(self, stream: str) -> str:
        spec = self._specs[stream]
        if (length := self._wrong_length.get(stream)) is not None:
            return (
                f"its frames {spec.layout.frame_id:#x} have {length} bytes, the layout {spec.layout.length}; "
                "correct the layout"
            )
        recent_ns = self._clock.monotonic_ns() - RECENT_NS
        others = [name for name, at_ns in self._others_ns.items() if at_ns >= recent_ns]
        if not others:
            raise KeyError(stream)
        named = ", ".join(others[:MOST_NAMED])
        more = f" and {len(others) - MOST_NAMED} more" if len(others) > MOST_NAMED else ""
        return (
            f"the bus works, as other frames come on {self._bus}: {named}{more}; compare the id "
            f"{spec.layout.frame_id:#x}, or check the device"
        )

    def __iter__(self) -> Iterator[str]:
        return (stream for stream in self._specs if self.get(stream) is not None)

    def __len__(self) -> int:
        return sum(1 for _ in self)
