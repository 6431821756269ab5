"""The figures that Home Assistant shows: rounded, now and then, and at once when something changes.

Detectors state several figures a second. Home Assistant keeps every state that it gets: at that rate a
healthy machine would fill its database by a gigabyte a day.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal

from pydantic import Field

from daqsvc.acquisition.clock import NS_PER_S
from daqsvc.publish.payloads import SCHEMA_ABOUT, Stamped, stamp_now

if TYPE_CHECKING:
    from collections.abc import Mapping

    from daqsvc.acquisition.clock import Clock
    from daqsvc.diagnosis.reading import Reading
    from daqsvc.diagnosis.record import Diagnosis
    from daqsvc.publish.home_assistant.settings import HomeAssistant
    from daqsvc.publish.output import Watched
    from daqsvc.publish.topics import Topics

LEAST_NS = 10 * NS_PER_S
"""Figures that change are sent this often at most."""

PROBABILITY_STEP = 0.1
"""Change of a probability from which on it is sent before its time."""

DIGITS: Mapping[str, int] = {
    "um": 1,
    "mil": 2,
    "mm": 4,
    "g": 3,
    "m/s2": 2,
    "mg": 1,
    "mm/s2": 0,
    "mm/s": 2,
    "V": 2,
    "rpm": 1,
    "deg": 1,
    "degC": 1,
    "degF": 1,
}
"""Decimal places by unit, so that the levels of a smooth machine still show two figures or so."""

DIGITS_OF_A_NUMBER = 3
"""Decimal places of a probability, and of what has no unit or an unknown one."""


class ReadingsPayload(Stamped):
    """What one detector finds and measures, rounded, for people to look at."""

    schema_: Literal["daqsvc.readings/1"] = Field(
        "daqsvc.readings/1", alias="schema", description=SCHEMA_ABOUT
    )
    machine: str = Field(description="name of the machine")
    detector: str = Field(description="name of the detector")
    finding: str | None = Field(
        description="the decision, with all that it cannot be told apart from, joined by 'or'; null without "
        "good data, and of a detector that only measures"
    )
    statistics: dict[str, float | None] = Field(description="null while the data are not good")
    probabilities: dict[str, float | None] = Field(description="null while the data are not good")


@dataclass(slots=True)
class _Shown:
    """What of a detector is known, and what has been published."""

    finds: bool = False
    readings: list[Reading] = field(default_factory=list)
    latest: Diagnosis | None = None
    published: dict[tuple[str, str], float | None] = field(default_factory=dict)
    published_finding: str | None = None
    published_ns: int | None = None


class Readings:
    """Decides which figures go out when.

    Args:
        settings: how often figures are sent.
        watched: the machine and its figures.
        topics: the box.
        clock: the service's clock.
    """

    def __init__(self, settings: HomeAssistant, watched: Watched, topics: Topics, clock: Clock) -> None:
        self._settings = settings
        self._machine = watched.machine
        self._topics = topics
        self._clock = clock
        self._shown: dict[str, _Shown] = {name: _Shown(finds=True) for name in watched.findings}
        for reading in watched.readings:
            self._shown.setdefault(reading.detector, _Shown()).readings.append(reading)

    def note(self, diagnosis: Diagnosis) -> None:
        """Take in what a detector states."""
        if (shown := self._shown.get(diagnosis.detector)) is not None:
            shown.latest = diagnosis

    def forget(self) -> None:
        """Nothing counts as published: there is a new connection, or Home Assistant has started again."""
        for shown in self._shown.values():
            shown.published_ns = None

    def due(self) -> list[tuple[str, bytes]]:
        """Topics and payloads to send now; they count as published."""
        messages = []
        for detector, shown in self._shown.items():
            if shown.latest is not None and self._is_due(shown):
                messages.append((self._topics.readings(self._machine, detector), self._tell(shown)))
        return messages

    def _is_due(self, shown: _Shown) -> bool:
        if shown.published_ns is None:
            return True
        since_ns = self._clock.monotonic_ns() - shown.published_ns
        if since_ns >= self._settings.every_s * NS_PER_S or _finding(shown) != shown.published_finding:
            return True
        if since_ns < LEAST_NS:
            return False
        now = _figures(shown)
        return any(self._moved(shown, reading, now) for reading in shown.readings)

    def _moved(self, shown: _Shown, reading: Reading, now: Mapping[tuple[str, str], float | None]) -> bool:
        value, shown_value = now[reading.kind, reading.key], shown.published[reading.kind, reading.key]
        if value is None or shown_value is None:
            return value is not shown_value
        if reading.kind == "probabilities":
            return abs(value - shown_value) > PROBABILITY_STEP
        coarse = 2.0 * 10.0 ** -digits_of(reading.unit)
        return abs(value - shown_value) > max(
            self._settings.deadband_percent / 100.0 * abs(shown_value), coarse
        )

    def _tell(self, shown: _Shown) -> bytes:
        assert shown.latest is not None  # noqa: S101 - asked for by `due` only where there is one
        shown.published_ns = self._clock.monotonic_ns()
        shown.published_finding = _finding(shown)
        shown.published = _figures(shown)

        def of(kind: str) -> dict[str, float | None]:
            return {key: value for (where, key), value in shown.published.items() if where == kind}

        return ReadingsPayload(
            **stamp_now(self._topics.site, self._topics.box, self._clock),
            machine=self._machine,
            detector=shown.latest.detector,
            finding=shown.published_finding,
            statistics=of("statistics"),
            probabilities=of("probabilities"),
        ).to_json()


def digits_of(unit: str) -> int:
    """Decimal places that a figure in this unit is sent with."""
    return DIGITS.get(unit, DIGITS_OF_A_NUMBER)


def _finding(shown: _Shown) -> str | None:
    diagnosis = shown.latest
    if not shown.finds or diagnosis is None or diagnosis.quality != "good":
        return None
    finding = " or ".join(diagnosis.group) if len(diagnosis.group) > 1 else diagnosis.decision
    return (
        f"{finding} at {diagnosis.where}" if diagnosis.where and diagnosis.severity != "normal" else finding
    )


def _figures(shown: _Shown) -> dict[tuple[str, str], float | None]:
    """The figures as they would be sent now; None where the detector has none, or no good data."""
    figures: dict[tuple[str, str], float | None] = {}
    for reading in shown.readings:
        value = math.nan
        if shown.latest is not None and shown.latest.quality == "good":
            stated = shown.latest.statistics if reading.kind == "statistics" else shown.latest.probabilities
            value = stated.get(reading.key, math.nan)
        figures[reading.kind, reading.key] = (
            round(value, digits_of(reading.unit)) if math.isfinite(value) else None
        )
    return figures
