"""The contract between a driver and the service; ``docs/driver-contract.md`` has it in words.

A driver owns one link. It takes frames off the bus, decodes them in bulk, and delivers blocks; it
keeps the link up by itself, counts what goes wrong, and lets no exception out. Drivers register by
entry point in the group ``daqsvc.drivers`` as a `drivers.plugin.DriverPlugin`. What this asks of them,
``tests/conformance/test_conformance.py`` tests over every transport.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Generic, Literal, Protocol, TypeVar

from daqsvc.acquisition.standing import tell_nobody
from daqsvc.errors.buses import DEVICE_ABSENT

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from daqsvc.acquisition.assembler import StreamCounters
    from daqsvc.acquisition.clock import Clock
    from daqsvc.acquisition.link import Link
    from daqsvc.acquisition.samples import SampleBlock
    from daqsvc.acquisition.standing import Tell
    from daqsvc.acquisition.timebase import TimeBaseState

LayoutT = TypeVar("LayoutT")

StartPolicy = Literal["error", "retry", "ignore"]
ControllerState = Literal["error-active", "error-warning", "error-passive", "bus-off"]


class DeviceAbsentError(Exception):
    """The device is not there at start, and the machine file states that this is an error."""

    code = DEVICE_ABSENT


class BusOptionError(ValueError):
    """An option of a bus cannot be used; raised by a driver that is made.

    Args:
        key: the option.
        problem: what is wrong with it, e.g. ``"is 0"``.
        remedy: what to do about it.
    """

    def __init__(self, key: str, problem: str, remedy: str) -> None:
        super().__init__(f"{key} {problem}; {remedy}")
        self.key = key


@dataclass(frozen=True, slots=True)
class StreamSpec(Generic[LayoutT]):
    """One stream on a bus.

    Attributes:
        name: name of the stream in the machine file.
        layout: where its counter and samples lie, in the sensors' physical units; of the kind that the
            bus's driver knows, e.g. `drivers.frames.FrameLayout`.
        rate_hz: nominal sampling rate.
        reorder_window_ns: how long a gap may wait for a late frame.
    """

    name: str
    layout: LayoutT
    rate_hz: float
    reorder_window_ns: int = 10_000_000


@dataclass(frozen=True, slots=True)
class BusPort:
    """All that a driver is given beside the table of its bus.

    Attributes:
        name: name of the bus in the machine file.
        streams: what is expected on the bus.
        clock: the service's clock.
        deliver: called with each block, on the event loop.
        start: what to do if the device is absent at start: fail, try again, or go on without it.
        tell: called on the event loop when a stream's samples become fit or unfit for judging;
            `StreamAssembler` does so.
    """

    name: str
    streams: Sequence[StreamSpec[Any]]
    clock: Clock
    deliver: Callable[[SampleBlock], None]
    start: StartPolicy = "retry"
    tell: Tell = tell_nobody


@dataclass(slots=True)
class BusCounters:
    """What happened on a bus beside its streams; every figure only grows.

    Attributes:
        frames_unknown: frames with an id that no stream has.
        frames_remote: remote-transmission requests.
        frames_error: error frames.
        bus_off: how often the controller went bus-off.
        open_failures: how often the bus could not be opened.
        reader_failures: how often the reader gave up on an unexpected error.
        unknown_ids: frames per unknown id, e.g. ``"0x7ff (11 bit)"``, for the first ids seen.
    """

    frames_unknown: int = 0
    frames_remote: int = 0
    frames_error: int = 0
    bus_off: int = 0
    open_failures: int = 0
    reader_failures: int = 0
    unknown_ids: dict[str, int] = field(default_factory=dict)

    @property
    def overruns(self) -> int:
        """What was lost to full buffers between the bus and this process, as far as that is known."""
        return 0

    @property
    def controller_state(self) -> ControllerState | None:
        """The state of the bus's controller; None if it has none that is known."""
        return None

    @property
    def frames_unrecorded(self) -> int:
        """Frames that should have been recorded and were not."""
        return 0


class Driver(Protocol):
    """One link, kept up.

    Making one opens nothing and starts nothing.
    """

    name: str
    link: Link

    @property
    def counters(self) -> BusCounters:
        """What happened on the bus beside its streams."""
        ...

    @property
    def streams(self) -> Mapping[str, tuple[StreamCounters, TimeBaseState]]:
        """Counters and clock of each stream, by name."""
        ...

    async def run(self) -> None:
        """Open the link and deliver blocks until cancelled; then hand over what is held back and close.

        Whatever is lost on the way is counted. Cancelled at any point, it leaves no task, thread or file
        behind, and the link down; it can then be called again. It returns by itself only if the device is
        absent at start and the policy is ``"ignore"``, or if there is nothing more to come.

        Raises:
            DeviceAbsentError: the device is absent at start and the policy is ``"error"``. Nothing else.
        """
        ...
