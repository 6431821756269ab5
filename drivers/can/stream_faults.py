"""Why no samples of a stream come although its bus is up: what comes instead of its frames."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

from daqsvc.acquisition.clock import NS_PER_S
from drivers.can.batches import EXTENDED, id_in_words

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from daqsvc.acquisition.clock import Clock
    from drivers.base import StreamSpec
    from drivers.frames import FrameLayout

QUIET_NS = NS_PER_S
"""A bus without a frame for so long is quiet."""
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
        self._other_pages: dict[str, Sequence[str]] = {}
        self._heard_ns: dict[str, int] = {}
        self._wrong_length: dict[str, int] = {}
        self._wrong_ns: dict[str, int] = {}

    def heard(self, stream: str) -> None:
        """Frames of a stream have come that can be read."""
        self._heard_ns[stream] = self._clock.monotonic_ns()
        self._wrong_length.pop(stream, None)

    def heard_other(self, name: str, pages_of: Sequence[str] = ()) -> None:
        """Frames have come that no stream has; their id in words.

        Args:
            name: the id, with the page if some page of this message is read.
            pages_of: the streams that read other pages of this message.
        """
        self._others_ns[name] = self._clock.monotonic_ns()
        self._other_pages[name] = pages_of

    def has_wrong_length(self, stream: str, length: int) -> None:
        """Frames with the id of a stream have come, of another length in bytes."""
        self._wrong_length[stream] = length
        self._wrong_ns[stream] = self._clock.monotonic_ns()

    def quiet(self) -> str:
        """That no frame at all comes, in a clause; empty if one came within `QUIET_NS`."""
        newest_ns = max(
            [*self._heard_ns.values(), *self._others_ns.values(), *self._wrong_ns.values()], default=None
        )
        if newest_ns is not None and self._clock.monotonic_ns() - newest_ns < QUIET_NS:
            return ""
        return f"no frame at all on {self._bus} for {QUIET_NS // NS_PER_S} s"

    def __getitem__(self, stream: str) -> str:
        spec = self._specs[stream]
        if (length := self._wrong_length.get(stream)) is not None:
            return (
                f"its frames {spec.layout.frame_id:#x} have {length} bytes, the layout {spec.layout.length}; "
                "correct the layout"
            )
        others = self._come_without(spec)
        if not others:
            raise KeyError(stream)
        pages = [name for name in others if stream in self._other_pages[name]]
        if pages:
            return (
                f"only other pages of its message come on {self._bus}: {_listed(pages)}; compare the DBC "
                "file with the manual of the device"
            )
        return (
            f"the bus works, as other frames come on {self._bus}: {_listed(others)}; compare the id "
            f"{id_in_words(spec.layout.frame_id | EXTENDED * spec.layout.extended)}, or check the device"
        )

    def _come_without(self, spec: StreamSpec[FrameLayout]) -> list[str]:
        """What comes though frames of a stream are missing, and not just came before the bus fell silent."""
        since_ns = self._clock.monotonic_ns() - RECENT_NS
        if spec.name in self._heard_ns:
            missing_ns = int(spec.layout.samples_per_frame / spec.rate_hz * NS_PER_S) + NS_PER_S
            since_ns = max(since_ns, self._heard_ns[spec.name] + missing_ns)
        return [name for name, at_ns in self._others_ns.items() if at_ns >= since_ns]

    def __iter__(self) -> Iterator[str]:
        return (stream for stream in self._specs if self.get(stream) is not None)

    def __len__(self) -> int:
        return sum(1 for _ in self)


def _listed(names: Sequence[str]) -> str:
    more = f" and {len(names) - MOST_NAMED} more" if len(names) > MOST_NAMED else ""
    return f"{', '.join(names[:MOST_NAMED])}{more}"
