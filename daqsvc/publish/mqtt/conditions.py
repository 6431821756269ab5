"""What there is to report of the broker: certificates that end, and messages that it will not take."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from daqsvc.acquisition.clock import NS_PER_S, iso_utc
from daqsvc.alarms.conditions import Condition
from daqsvc.alarms.states import Level

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

NS_PER_DAY = 86_400 * NS_PER_S

REFUSED = "broker/refused"
"""The condition of messages that the broker will not take."""
CERTIFICATE = "certificate/"
"""How the names of the conditions of certificates begin."""
BROKER = "broker"
UNUSED = "it is no longer in use"

REFUSED_NAMED = 3
"""Topics that the condition of refused messages names."""

CERTIFICATE_DAYS = 14
CERTIFICATE_DEADBAND_NS = NS_PER_DAY
"""A clock that is set by an hour, and back, makes no alarm come and go."""


@dataclass(frozen=True, slots=True, kw_only=True)
class BrokerVitals:
    """What is examined.

    Attributes:
        wall_ns: wall clock, ns since the Unix epoch.
        certificates_end_ns: by certificate, when it ends, wall clock.
        has_expired: whether the broker is refused because its certificate has expired.
        connected: whether all certificates in use have been seen, since there is a connection.
        refused: by topic, why the broker will not take messages.
        is_refused_known: whether these are all there are: what an earlier run has left was read, and the
            broker was asked.
        reported: conditions that were ever reported, also before a restart.
    """

    wall_ns: int
    certificates_end_ns: Mapping[str, int] = field(default_factory=dict)
    has_expired: bool = False
    connected: bool = True
    refused: Mapping[str, str] = field(default_factory=dict)
    is_refused_known: bool = False
    reported: frozenset[str] = frozenset()


class BrokerCheck:
    """Remembers which certificates are about to end, and states the present state with the broker.

    What is not known yet is not reported as normal: an alarm that was active before a restart would return,
    and come again.
    """

    def __init__(self) -> None:
        self._ending: set[str] = set()

    def look(self, vitals: BrokerVitals) -> Iterator[Condition]:
        """The state of everything, as far as it is known, whether that is new or not."""
        for name, end_ns in sorted(vitals.certificates_end_ns.items()):
            if not (name == BROKER and vitals.has_expired):
                yield self._certificate(name, end_ns - vitals.wall_ns, end_ns)
        if vitals.has_expired:
            # The certificate that was last verified need not be the present one.
            sentence = "the broker is refused: its certificate, or one behind it, has expired; renew it there"
            yield Condition(f"{CERTIFICATE}{BROKER}", Level.DANGER, sentence)
        if vitals.connected:
            seen = {f"{CERTIFICATE}{name}" for name in vitals.certificates_end_ns}
            for name in sorted(vitals.reported - seen):
                if name.startswith(CERTIFICATE):
                    yield Condition(name, Level.NORMAL, UNUSED)
        if vitals.refused or vitals.is_refused_known:
            yield _refusals(vitals.refused)

    def _certificate(self, name: str, left_ns: int, end_ns: int) -> Condition:
        condition = f"{CERTIFICATE}{name}"
        border_ns = CERTIFICATE_DAYS * NS_PER_DAY
        if left_ns < border_ns:
            self._ending.add(name)
        elif left_ns >= border_ns + CERTIFICATE_DEADBAND_NS:
            self._ending.discard(name)
        if name not in self._ending:
            return Condition(condition, Level.NORMAL, f"certificate {name} lasts until {iso_utc(end_ns)}")
        if left_ns <= 0:
            sentence = f"certificate {name} ended at {iso_utc(end_ns)}: without a new one there is no broker"
            return Condition(condition, Level.DANGER, sentence)
        # No count of days: it would be another sentence every day.
        sentence = (
            f"certificate {name} ends at {iso_utc(end_ns)}, in less than {CERTIFICATE_DAYS} days: renew it"
        )
        return Condition(condition, Level.ALERT, sentence)


def _refusals(refused: Mapping[str, str]) -> Condition:
    if not refused:
        return Condition(REFUSED, Level.NORMAL, "the broker takes all messages")
    # No count: it would be another sentence each time.
    named = "; ".join(f"{topic} ({reason})" for topic, reason in sorted(refused.items())[:REFUSED_NAMED])
    others = ", and others" if len(refused) > REFUSED_NAMED else ""
    sentence = (
        f"the broker will not take messages on {named}{others}: they wait on disk and are tried again; allow "
        "them there"
    )
    return Condition(REFUSED, Level.ALERT, sentence)
