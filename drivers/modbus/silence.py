"""Who does not answer on a Modbus line: a unit that is dead, or one request of a unit that lives.

Either is set aside after a few requests without reply, and asked again ever more rarely. A unit is dead when
nothing that it is asked is answered any more: a queue that it does not have must not cost its other streams
their samples.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple, TypeAlias

from daqsvc.acquisition.clock import NS_PER_S
from daqsvc.acquisition.sparing import OFTEN, Sparing
from drivers.modbus.outcomes import NoReplyError
from drivers.modbus.replies import WRITE_REGISTERS

if TYPE_CHECKING:
    from drivers.modbus.outcomes import ModbusCounters

logger = logging.getLogger(__name__)

LONGEST_DEMOTION_NS = 60 * NS_PER_S


class UnitSetAsideError(NoReplyError):
    """The unit, or this request of it, has stayed without reply, and it is not yet time to ask again."""


@dataclass(frozen=True, slots=True)
class RetryPolicy:
    """How long to bear with a line and its units.

    Attributes:
        quiet_ns: silence kept on a serial line after a request that failed; at least the response time-out.
        gap_ns: silence between frames on a serial line.
        demote_after: requests without reply, in a row, after which a unit, or one request, is set aside.
        demotion_ns: how long it is set aside, before one request probes whether it is back; twice as long
            after each probe without reply, up to `LONGEST_DEMOTION_NS` if that is more.
        timeout_ns: how long a unit may take to answer.
    """

    quiet_ns: int
    gap_ns: int
    demote_after: int = 3
    demotion_ns: int = 10 * NS_PER_S
    timeout_ns: int = 0

    @property
    def hold_ns(self) -> int:
        """How long a request without reply holds the line."""
        return self.timeout_ns + self.quiet_ns

    @property
    def opening_ns(self) -> int:
        """Silence on a serial line that was opened: as if whoever had it before had just asked."""
        return self.hold_ns if self.quiet_ns else 0

    @property
    def longest_demotion_ns(self) -> int:
        """The longest time from a probe to the next."""
        return max(self.demotion_ns, LONGEST_DEMOTION_NS)

    @property
    def of_probes(self) -> str:
        """When is asked again, in words."""
        first_s, longest_s = self.demotion_ns / NS_PER_S, self.longest_demotion_ns / NS_PER_S
        if first_s == longest_s:
            return f"asked again every {first_s:g} s"
        return f"asked again in {first_s:g} s, then after times that double up to {longest_s:g} s"


class Enquiry(NamedTuple):
    """What a unit is asked again and again, and what is set aside by itself.

    Attributes:
        function: code of the function.
        what: what it is for, in words.
    """

    function: int
    what: str = ""

    def __str__(self) -> str:
        return f"function {self.function}" + (f" for {self.what}" if self.what else "")


@dataclass(slots=True)
class Silence:
    """Requests without reply in a row, and when to ask again.

    Attributes:
        enquiry: what was asked.
        failures: requests without reply in a row.
        wait_ns: how long it is set aside at a time.
        probe_ns: when to ask again; None if it is not set aside.
        hopeful: whether there was a reply when it was asked last, or it has not been asked yet.
    """

    enquiry: Enquiry
    failures: int = 0
    wait_ns: int = 0
    probe_ns: int | None = None
    hopeful: bool = False

    def set_aside(self, patience: RetryPolicy, now_ns: int) -> bool:
        """Let nobody ask for a while; returns whether that is new."""
        new = self.probe_ns is None
        self.wait_ns = patience.demotion_ns if new else min(2 * self.wait_ns, patience.longest_demotion_ns)
        self.probe_ns = now_ns + self.wait_ns
        return new

    def end(self) -> None:
        """There was an answer."""
        self.failures, self.probe_ns = 0, None


SparingByEnquiry: TypeAlias = dict[tuple[int, Enquiry], Sparing]
"""How often it has been said of a unit, or of what it is asked, that there is no reply."""


class UnitSilence:
    """What is known about the silence of a unit.

    Args:
        unit: its address.
        patience: how long to bear with it.
        counters: of the bus.
        sparing: what has been said of it, also while the line was open before.
    """

    def __init__(
        self,
        unit: int,
        patience: RetryPolicy,
        counters: ModbusCounters,
        sparing: SparingByEnquiry | None = None,
    ) -> None:
        self._unit = unit
        self._patience = patience
        self._counters = counters
        self._whole = Silence(Enquiry(0, "anything"))
        self._enquiries: dict[Enquiry, Silence] = {}
        self._last_words = ""
        self._sparing: SparingByEnquiry = {} if sparing is None else sparing

    @property
    def dead(self) -> bool:
        """Whether the whole unit is set aside."""
        return self._whole.probe_ns is not None

    def of(self, enquiry: Enquiry) -> Silence:
        """What is known about an enquiry; one that is new may be answered."""
        silence = self._enquiries.get(enquiry)
        if silence is None:
            silence = self._enquiries[enquiry] = Silence(enquiry, hopeful=_is_repeated(enquiry))
        return silence

    def check(self, silence: Silence, now_ns: int) -> None:
        """Make sure that this may be asked now.

        Raises:
            UnitSetAsideError: it is not yet time.
        """
        for kept in (self._whole, silence):
            if kept.probe_ns is not None and now_ns < kept.probe_ns:
                raise UnitSetAsideError(f"unit {self._unit} is set aside: {self._last_words}")

    def doubts(self, silence: Silence) -> bool:
        """Whether this may well stay without reply."""
        return self.dead or silence.failures > 0

    def probes(self, silence: Silence) -> bool:
        """Whether this, asked now, is to find out if somebody is back."""
        return self.dead or silence.probe_ns is not None

    def answered(self, silence: Silence, *, refused: bool = False) -> None:
        """There was a reply.

        Args:
            silence: what was asked.
            refused: whether the unit refuses: it lives now, but need not be asked that again.
        """
        silence.hopeful = not refused and _is_repeated(silence.enquiry)
        if self.dead:
            self._counters.units_back += 1
            for other in self._enquiries.values():
                other.end()
        elif silence.probe_ns is not None:
            self._counters.requests_back += 1
        if self._say_end(self._whole, "unit %d is back", self._unit):
            for (unit, _), sparing in self._sparing.items():
                if unit == self._unit:
                    sparing.may_take_back()
        self._say_end(silence, "unit %d answers %s again", self._unit, silence.enquiry)
        self._whole.end()
        silence.end()

    def missed(self, silence: Silence, why: str, now_ns: int) -> None:
        """There was no reply, because of ``why``."""
        whole, patience = self._whole, self._patience
        whole.failures += 1
        silence.failures += 1
        silence.hopeful = False
        self._last_words = why
        lives = any(other.hopeful for other in self._enquiries.values())
        if not lives and whole.failures >= patience.demote_after:
            if whole.set_aside(patience, now_ns):
                self._counters.units_demoted += 1
            self._say(whole, "%s; the unit is set aside, and %s%s", why, patience.of_probes)
            if len(self._enquiries) > 1:
                # Something else is to probe next: this one may be what the unit does not know.
                silence.probe_ns = now_ns + whole.wait_ns + patience.demotion_ns
        elif silence.failures >= patience.demote_after:
            if silence.set_aside(patience, now_ns):
                self._counters.requests_demoted += 1
            self._say(silence, "%s; %s is set aside, and %s%s", why, silence.enquiry, patience.of_probes)

    def _say(self, silence: Silence, message: str, *arguments: object) -> None:
        sparing = self._sparing.setdefault((self._unit, silence.enquiry), Sparing())
        if sparing.may_say():
            logger.warning(message, *arguments, OFTEN if sparing.often else "")

    def _say_end(self, silence: Silence, message: str, *arguments: object) -> bool:
        sparing = self._sparing.get((self._unit, silence.enquiry))
        if sparing is None or not sparing.may_take_back():
            return False
        logger.warning(message, *arguments)
        return True


def _is_repeated(enquiry: Enquiry) -> bool:
    """Whether it is asked again and again: nobody need ever write again."""
    return enquiry.function != WRITE_REGISTERS
