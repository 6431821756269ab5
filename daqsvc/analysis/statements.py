"""What any detector of the service said over a recording, condensed."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from daqsvc.acquisition.clock import NS_PER_S
from daqsvc.analysis.result import finite
from daqsvc.diagnosis.detector import Window

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping

    from numpy.typing import NDArray

    from daqsvc.diagnosis.detector import Detector
    from daqsvc.diagnosis.record import Diagnosis

    Floats = NDArray[np.float64]

_SEVERITIES = ("normal", "alert", "danger")
_BLOCKS = 256
"""Blocks handed over at a time."""


@dataclass(frozen=True, slots=True)
class Statements:
    """All that a detector said.

    Attributes:
        detector: its name.
        diagnoses: in order.
        rate_hz: sampling rate of the recording.
        faults: of a rotor bank, the fault that each mode stands for.
    """

    detector: str
    diagnoses: tuple[Diagnosis, ...]
    rate_hz: float
    faults: Mapping[str, str] = field(default_factory=dict)

    @property
    def last(self) -> Diagnosis | None:
        """The last statement; None if it said nothing."""
        return self.diagnoses[-1] if self.diagnoses else None

    @property
    def worst(self) -> Diagnosis | None:
        """The first of its most severe statements that rest on good data; None without any."""
        sound = [said for said in self.diagnoses if said.quality == "good"]
        return max(sound, key=lambda said: _SEVERITIES.index(said.severity), default=None)

    def changes(self) -> Iterator[Diagnosis]:
        """The statements that say something else than the one before."""
        before: tuple[str, str, str] | None = None
        for said in self.diagnoses:
            now = (said.decision, said.severity, said.quality)
            if now != before:
                yield said
            before = now

    def as_json(self) -> dict[str, Any]:
        """For the output."""
        last = self.last
        if last is None:
            return {
                "decision": None,
                "quality": "missing",
                "reason": "it said nothing",
                "worst": None,
                "history": [],
            }
        worst = self.worst
        said: dict[str, Any] = finite(
            {
                "decision": last.decision,
                "severity": last.severity,
                "group": list(last.group),
                "probabilities": dict(last.probabilities),
                "evidence": dict(last.evidence),
                "statistics": dict(last.statistics),
                "units": dict(last.units),
                "thresholds": dict(last.thresholds),
                "quality": last.quality,
                "reason": last.reason,
                "sensors": list(last.sensors),
                "worst": None if worst is None else self._step(worst),
                "history": [self._step(change) for change in self.changes()],
            }
        )
        return said

    def describe(self) -> str:
        """One line for a person."""
        last = self.last
        if last is None:
            return f"{self.detector}: the recording is too short for it"
        doubt = f" (data {last.quality}: {last.reason})" if last.quality != "good" else ""
        figures = ", ".join(
            f"{name} {value:.4g} {last.units.get(name, '')}".rstrip()
            for name, value in last.statistics.items()
            if not name.startswith("paper.")
        )
        worst = self.worst
        before = ""
        if worst is not None and worst.severity != last.severity:
            before = f", {worst.severity} at {worst.first_index / self.rate_hz:.3f} s"
        return f"{self.detector}: {last.decision} ({last.severity}{before}){doubt}; {figures}"

    def _step(self, said: Diagnosis) -> dict[str, Any]:
        return {
            "sample": said.end_index,
            "seconds": said.end_index / self.rate_hz,
            "revolution": said.revolutions,
            "onset_sample": said.first_index,
            "decision": said.decision,
            "severity": said.severity,
            "quality": said.quality,
        }


def by_name(
    detector: str, diagnoses: Iterable[Diagnosis], rate_hz: float, faults: Mapping[str, str]
) -> list[Statements]:
    """What a detector said, apart by whom it speaks for: a level detector speaks for each of its sensors.

    Args:
        detector: its name.
        diagnoses: in order.
        rate_hz: sampling rate of the recording.
        faults: see `Statements`.
    """
    said: dict[str, list[Diagnosis]] = {}
    for diagnosis in diagnoses:
        said.setdefault(diagnosis.detector, []).append(diagnosis)
    return [
        Statements(name, tuple(of_name), rate_hz, faults)
        for name, of_name in (said or {detector: []}).items()
    ]


def worst(statements: Iterable[Statements]) -> str:
    """The most severe of what several detectors said, in words; empty if all is normal."""
    found = [(said.detector, said.worst, said.rate_hz) for said in statements if said.worst is not None]
    alarmed = [one for one in found if one[1].severity != "normal"]
    if not alarmed:
        return ""
    name, diagnosis, rate_hz = max(alarmed, key=lambda one: _SEVERITIES.index(one[1].severity))
    return f"{name}, {diagnosis.severity} from {diagnosis.first_index / rate_hz:.3f} s on"


def listen(
    detector: Detector, samples: Floats, rate_hz: float, progress: Callable[[int, int], None] | None = None
) -> Iterator[Diagnosis]:
    """Have a detector process a recording.

    Args:
        detector: a new one.
        samples: float64 ``[n, channels]`` in the units and columns of its stream; NaN where missing.
        rate_hz: sampling rate.
        progress: told the samples done and to do.

    Yields:
        What it says.
    """
    period_ns = NS_PER_S / rate_hz
    length = detector.block * _BLOCKS
    for begin in range(0, len(samples), length):
        part = samples[begin : begin + length].astype(np.float32)
        whole = len(part) // detector.block * detector.block
        if whole:
            end_ns = round((begin + whole - 1) * period_ns)
            yield from detector.process(Window(begin, part[:whole], end_ns, period_ns))
        if progress is not None:
            progress(begin + len(part), len(samples))
