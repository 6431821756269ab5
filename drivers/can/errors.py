"""Error frames of a CAN controller, read as the health of the bus.

Linux hands them over as frames whose id holds the classes of error and whose eight data bytes hold the
details (``linux/can/error.h``). They come from the receiver's own controller, never over the wire.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from drivers.base import BusCounters, ControllerState

if TYPE_CHECKING:
    from numpy.typing import NDArray


TX_TIMEOUT = 0x001
ARBITRATION_LOST = 0x002
CONTROLLER = 0x004
PROTOCOL = 0x008
TRANSCEIVER = 0x010
NO_ACKNOWLEDGE = 0x020
BUS_OFF = 0x040
BUS_ERROR = 0x080
RESTARTED = 0x100
ERROR_COUNTERS = 0x200
ALL_CLASSES = 0x1FFF_FFFF

_RX_OVERFLOW = 0x01
_TX_OVERFLOW = 0x02
_WARNING = 0x04 | 0x08
_PASSIVE = 0x10 | 0x20
_ACTIVE = 0x40
"""Bits of data[1] in a frame of class `CONTROLLER`."""


_PLAIN_CLASSES: dict[str, int] = {
    "tx_timeouts": TX_TIMEOUT,
    "arbitration_lost": ARBITRATION_LOST,
    "protocol_violations": PROTOCOL,
    "transceiver_faults": TRANSCEIVER,
    "no_acknowledge": NO_ACKNOWLEDGE,
    "bus_off": BUS_OFF,
    "bus_errors": BUS_ERROR,
    "restarts": RESTARTED,
}

EXPLAINED: dict[ControllerState, str] = {
    "error-warning": "its controller counts more than 95 errors; look at wiring, termination and bit rate",
    "error-passive": "its controller counts more than 127 errors and cannot flag errors any more; "
    "look at wiring, termination and bit rate",
    "error-active": "the errors have ceased",
}
BUS_OFF_REASON = "the controller went bus-off (wiring, termination or bit rate)"


@dataclass(slots=True)
class CanCounters(BusCounters):
    """What happened on a CAN bus beside its streams; figures only grow, the last three are states.

    Attributes:
        frames_overrun: frames that the kernel dropped because the receive buffer was full, counted exactly.
        frames_malformed: what came from the socket and was no CAN frame.
        rx_overflows: how often the controller's own receive buffer overflowed; frames are lost each time.
        tx_overflows: how often its transmit buffer did.
        tx_timeouts: transmissions that its driver gave up.
        arbitration_lost: arbitrations lost.
        protocol_violations: bit, form and stuff errors.
        no_acknowledge: frames that nobody acknowledged.
        transceiver_faults: faults that the transceiver reported.
        bus_errors: errors on the bus.
        error_warnings: how often the controller reached the warning limit of 96 errors.
        error_passives: how often it became error-passive (128 errors).
        restarts: how often it came back after bus-off.
        frames_recorded: frames that are in the recording of the bus.
        frames_unrecorded: frames that are not, because the disk refused them or was too slow.
        recorder_failures: how often the recording began again because its thread was lost.
        controller_state: its state as last reported; error-active until something else is reported.
        tx_errors: its transmit error counter as last reported.
        rx_errors: its receive error counter as last reported.
    """

    frames_overrun: int = 0
    frames_malformed: int = 0
    rx_overflows: int = 0
    tx_overflows: int = 0
    tx_timeouts: int = 0
    arbitration_lost: int = 0
    protocol_violations: int = 0
    no_acknowledge: int = 0
    transceiver_faults: int = 0
    bus_errors: int = 0
    error_warnings: int = 0
    error_passives: int = 0
    restarts: int = 0
    frames_recorded: int = 0
    frames_unrecorded: int = 0
    recorder_failures: int = 0
    controller_state: ControllerState = "error-active"
    tx_errors: int = 0
    rx_errors: int = 0

    @property
    def overruns(self) -> int:
        """See `drivers.base.BusCounters`: frames that the kernel dropped, and overflows before it."""
        return self.frames_overrun + self.rx_overflows

    def add(self, errors: ErrorCounts) -> None:
        """Add what error frames reported."""
        for name, count in errors.counts.items():
            setattr(self, name, getattr(self, name) + count)
        if errors.state is not None:
            self.controller_state = errors.state
        if errors.error_counters is not None:
            self.tx_errors, self.rx_errors = errors.error_counters


@dataclass(frozen=True, slots=True)
class ErrorCounts:
    """What a run of error frames states.

    Attributes:
        counts: what to add to which counter of `CanCounters`.
        state: the controller's state at the end; None if no frame stated it.
        error_counters: its transmit and receive error counters; None if no frame stated them.
    """

    counts: dict[str, int] = field(default_factory=dict)
    state: ControllerState | None = None
    error_counters: tuple[int, int] | None = None

    @property
    def bus_off(self) -> bool:
        """Whether one of the frames reported bus-off."""
        return self.counts.get("bus_off", 0) > 0

    @classmethod
    def of(cls, classes: NDArray[np.uint32], data: NDArray[np.uint8]) -> ErrorCounts:
        """Read error frames.

        Args:
            classes: uint32 ``[n]``, their ids; flags of the kernel in them do not matter.
            data: uint8 ``[n, 8]``, their payloads.
        """
        counts = {name: int(((classes & bit) != 0).sum()) for name, bit in _PLAIN_CLASSES.items()}
        status = np.where(classes & CONTROLLER, data[:, 1], 0)
        counts["rx_overflows"] = int(((status & _RX_OVERFLOW) != 0).sum())
        counts["tx_overflows"] = int(((status & _TX_OVERFLOW) != 0).sum())
        counts["error_warnings"] = int(((status & _WARNING) != 0).sum())
        counts["error_passives"] = int(((status & _PASSIVE) != 0).sum())
        counting = np.flatnonzero(classes & ERROR_COUNTERS)
        last = None if not len(counting) else (int(data[counting[-1], 6]), int(data[counting[-1], 7]))
        return cls({name: n for name, n in counts.items() if n}, _state(classes, status), last)

    def followed_by(self, later: ErrorCounts) -> ErrorCounts:
        """Both, one after the other."""
        names = {*self.counts, *later.counts}
        return replace(
            later,
            counts={name: self.counts.get(name, 0) + later.counts.get(name, 0) for name in names},
            state=later.state or self.state,
            error_counters=later.error_counters or self.error_counters,
        )


def _state(classes: NDArray[np.uint32], status: NDArray[np.uint8]) -> ControllerState | None:
    """The state that the last frame which states one leaves the controller in."""
    stating = np.flatnonzero(
        ((classes & (BUS_OFF | RESTARTED)) != 0) | ((status & (_WARNING | _PASSIVE | _ACTIVE)) != 0)
    )
    if not len(stating):
        return None
    last_class, last_status = int(classes[stating[-1]]), int(status[stating[-1]])
    if last_class & BUS_OFF:
        return "bus-off"
    if last_status & _PASSIVE:
        return "error-passive"
    if last_status & _WARNING:
        return "error-warning"
    return "error-active"
