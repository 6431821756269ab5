"""The alarms that a rotor raised over a recording: what each was, since when, and whether it went away."""

from __future__ import annotations

import bisect
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from daqsvc.analysis.result import Instant, told, words

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from daqsvc.rotor.synchronous.identify import Identification
    from daqsvc.rotor.synchronous.signatures import RotorFault
    from daqsvc.rotor.synchronous.watch import WatchReport


@dataclass(frozen=True, slots=True)
class RotorAlarm:
    """A departure, and what came of it until the next one or until the machine was healthy again.

    Attributes:
        onset: estimated begin of the change.
        departure: where the alarm was raised.
        declaration: where its last group was first named; None if it never was.
        verdict: the most likely fault by its last look; None if it was over before there was one.
        group: all that could not be told apart, the most likely first.
        returned: where the machine was found healthy again; None if it was not.
    """

    onset: Instant
    departure: Instant
    declaration: Instant | None
    verdict: RotorFault | None
    group: tuple[RotorFault, ...]
    returned: Instant | None

    def as_json(self) -> dict[str, Any]:
        """For the output."""
        instants = {
            "departure": self.departure,
            "onset": self.onset,
            "declaration": self.declaration,
            "returned": self.returned,
        }
        found: dict[str, Any] = {
            name: None if instant is None else instant.as_json() for name, instant in instants.items()
        }
        return found | {"verdict": self.verdict, "group": list(self.group)}

    def describe(self) -> str:
        """One line for a person."""
        what = " or ".join(words(name) for name in self.group) or "a change that got no look"
        named = (
            "not named" if self.declaration is None else f"named at revolution {self.declaration.revolution}"
        )
        after = "" if self.returned is None else f"; healthy again at {told(self.returned)}"
        return (
            f"alarm at {told(self.departure)}: {what}, changed at revolution {self.onset.revolution}, "
            f"{named}{after}"
        )


@dataclass(frozen=True, slots=True)
class Places:
    """Where the revolutions of a recording lie.

    Attributes:
        reports: one for each revolution that could be fitted.
        period_samples: float64, samples in each of them.
        rate_hz: sampling rate.
    """

    reports: Sequence[WatchReport]
    period_samples: NDArray[Any]
    rate_hz: float

    def onset(self, departed: WatchReport) -> Instant:
        """Where the revolution begins that the change is estimated to begin with."""
        first = departed.onset_revolution or departed.revolution
        place = bisect.bisect_left(self.reports, first, key=lambda report: report.revolution)
        place = min(place, len(self.reports) - 1)
        begin = self.reports[place].end_index - round(float(self.period_samples[place]))
        return self._instant(max(0, begin), first - 1)

    def end_of(self, report: WatchReport) -> Instant:
        """Where a revolution ends."""
        return self._instant(report.end_index, report.revolution)

    def _instant(self, sample: int, revolution: int) -> Instant:
        return Instant(sample, sample / self.rate_hz, revolution)


def rotor_alarms(places: Places, last: Identification | None) -> tuple[RotorAlarm, ...]:
    """Every alarm of a recording, in order.

    The departure that takes a machine back to its healthy state is no alarm, but the end of the one before.

    Args:
        places: the recording.
        last: the look at its end; None if the machine is healthy then.
    """
    alarms: list[RotorAlarm] = []
    segment: list[WatchReport] = []
    up = 0  # alarms before those that are up

    def clear(at: WatchReport) -> None:
        nonlocal up
        closing = _alarm(places, segment)
        # The way back to health is a change, too: the end of the alarm before and not one of its own.
        if len(alarms) == up or set(closing.group) not in ({*alarms[-1].group}, set()):
            alarms.append(closing)
        alarms[up:] = [replace(alarm, returned=places.end_of(at)) for alarm in alarms[up:]]
        up = len(alarms)
        segment.clear()

    for report in places.reports:
        if report.departed:
            if segment:
                alarms.append(_alarm(places, segment))
            segment = [report]
        elif segment and report.state == "watching":
            clear(report)
        elif segment:
            segment.append(report)
    if segment and last is not None and last.verdict == "normal":
        clear(segment[-1])
    elif segment:
        alarms.append(_alarm(places, segment, last))
    return tuple(alarms)


def declared_at(
    places: Places, reports: Sequence[WatchReport], last: Identification | None
) -> Instant | None:
    """Where a group was first named.

    Args:
        places: the recording.
        reports: among which to look, in order.
        last: the look that names it; None if none does.
    """
    if last is None or not last.named:
        return None
    for report in reports:
        said = report.identification
        if report.looked and said is not None and said.named and set(said.group) == set(last.group):
            return places.end_of(report)
    return places.end_of(places.reports[-1])


def _alarm(places: Places, segment: Sequence[WatchReport], last: Identification | None = None) -> RotorAlarm:
    looks = [report.identification for report in segment if report.looked and report.identification]
    # A name is kept through one look that sees a healthy machine: such a look says nothing of the fault.
    faulty = [look for look in looks if look.verdict != "normal" and "normal" not in look.candidates]
    seen = last or (faulty[-1] if faulty else None)
    return RotorAlarm(
        onset=places.onset(segment[0]),
        departure=places.end_of(segment[0]),
        declaration=declared_at(places, segment, seen),
        verdict=None if seen is None else seen.verdict,
        group=() if seen is None else seen.group,
        returned=None,
    )
