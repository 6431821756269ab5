"""How a Modbus request can end, and what is counted on a line."""

from __future__ import annotations

from dataclasses import dataclass, field

from drivers.base import BusCounters
from drivers.modbus.replies import EXCEPTIONS


class LineLostError(Exception):
    """The connection or the port is gone, or cannot be opened."""


class NoReplyError(Exception):
    """A unit has not answered in time, or what it answered was no reply to the request."""


class RequestRefusedError(Exception):
    """A unit has answered with a Modbus exception.

    Attributes:
        code: the exception code.
    """

    def __init__(self, message: str, code: int) -> None:
        super().__init__(message)
        self.code = code


@dataclass(slots=True)
class ModbusCounters(BusCounters):
    """What happened on a Modbus line; every figure only grows.

    Attributes:
        requests: requests sent.
        replies: sound replies, refusals included.
        timeouts: requests without a sound reply in time.
        exceptions: refusals by kind, e.g. ``"illegal data address"``.
        replies_truncated: replies shorter than what was asked for, or cut off.
        replies_oversized: replies longer than what was asked for, or than any reply may be.
        replies_corrupt: RTU frames whose CRC does not match, and bytes that are no frame.
        replies_wrong_unit: frames of another unit than was asked.
        replies_wrong_transaction: TCP frames that answer no request under way.
        replies_wrong_function: frames that answer another function.
        replies_wrong_protocol: TCP frames that are not Modbus.
        replies_unasked: bunches of bytes on a serial line while no reply was waited for: late replies.
        units_demoted: how often a silent unit was set aside.
        units_back: how often one was found to be back.
        requests_demoted: how often requests of a unit that answers others were set aside.
        requests_back: how often such were answered again.
        probes: requests made to see whether what was set aside is answered again.
        blocks_torn: waveform blocks that the device replaced while they were read.
        blocks_missed: waveform blocks that were over before they could be read.
        ring_overruns: how often a ring was overwritten before it was read.
        counts_doubted: write counters and block ids that another look did not bear out.
    """

    requests: int = 0
    replies: int = 0
    timeouts: int = 0
    exceptions: dict[str, int] = field(default_factory=dict)
    replies_truncated: int = 0
    replies_oversized: int = 0
    replies_corrupt: int = 0
    replies_wrong_unit: int = 0
    replies_wrong_transaction: int = 0
    replies_wrong_function: int = 0
    replies_wrong_protocol: int = 0
    replies_unasked: int = 0
    units_demoted: int = 0
    units_back: int = 0
    requests_demoted: int = 0
    requests_back: int = 0
    probes: int = 0
    blocks_torn: int = 0
    blocks_missed: int = 0
    ring_overruns: int = 0
    counts_doubted: int = 0

    def note(self, fault: str) -> None:
        """Count a faulty reply."""
        name = f"replies_{fault}"
        setattr(self, name, getattr(self, name) + 1)

    def note_exception(self, code: int) -> str:
        """Count a refusal, and return what it is called."""
        kind = EXCEPTIONS.get(code, f"exception {code}")
        self.exceptions[kind] = self.exceptions.get(kind, 0) + 1
        return kind
