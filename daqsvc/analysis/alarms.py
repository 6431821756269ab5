"""The alarms that a rotor raised over a recording: what each was, since when, and whether it went away."""

from __future__ import annotations

import bisect
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from daqsvc.analysis.result import Instant, RotorAlarm

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from daqsvc.rotor.synchronous.identify import Identification
    from daqsvc.rotor.synchronous.watch import WatchReport


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
