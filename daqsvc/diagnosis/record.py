"""What a detector states: an immutable record with its evidence."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    from collections.abc import Mapping

    from daqsvc.dsp.quality import Quality

Severity = Literal["normal", "alert", "danger"]


@dataclass(frozen=True, slots=True)
class Diagnosis:
    """One statement of one detector about one machine at one time.

    Attributes:
        machine: name of the machine.
        detector: name of the detector in the machine file.
        t_ns: monotonic time of the last sample that went in (`SampleRing.time_of`).
        stream: the stream the samples came from.
        first_index: first sample of the window of evidence (absolute index).
        end_index: one past its last sample.
        decision: the mode or level that the detector holds now, e.g. ``"F1L2"`` or ``"alert"``;
            ``"undetermined"`` while it cannot decide.
        where: the part of the machine that it is about, e.g. the name of a bearing; empty if it is about the
            machine as a whole.
        changed: whether ``decision`` differs from the one before.
        severity: how bad the decision is.
        probabilities: conditional probability per mode, summing to one; empty if the detector has none.
        group: modes that the evidence cannot tell apart, the decision among them.
        statistics: what was measured, by name, e.g. ``{"rms": 0.07}``.
        units: unit of each statistic, by the same names; a pure number has none.
        thresholds: limits that the statistics were compared with, e.g. ``{"rms.alert": 0.11}``.
        evidence: log-likelihood ratios in nats, by name.
        revolutions: shaft revolutions since the detector started, where it follows the shaft.
        quality: ``"good"``; ``"missing"`` if too many samples of the window are missing, or nothing can be
            judged by the stream (another rate than the file states, a counter that stands still);
            ``"not_ok"`` if a sensor is outside its OK limits, dead or clipped. Unless it is good,
            ``decision`` is held from before: missing data never clears anything. Only where ``bounds`` show
            that it must be worse whatever is missing it may rise.
        reason: why the quality is not good, in words for a person; if it is, what to know of the decision.
        sensors: names of the sensors that the statement rests on.
        model: name and version of the model behind the decision.
        missing_share: share of the window's samples that are missing; None if the detector does not state it.
        bounds: statistics that are uncertain because samples are missing: between what they lie all the
            same. Such a one may raise an alarm by its bound, and returns none.
    """

    machine: str
    detector: str
    t_ns: int
    stream: str
    first_index: int
    end_index: int
    decision: str
    changed: bool = False
    severity: Severity = "normal"
    probabilities: Mapping[str, float] = field(default_factory=dict)
    group: tuple[str, ...] = ()
    statistics: Mapping[str, float] = field(default_factory=dict)
    units: Mapping[str, str] = field(default_factory=dict)
    thresholds: Mapping[str, float] = field(default_factory=dict)
    evidence: Mapping[str, float] = field(default_factory=dict)
    revolutions: float | None = None
    quality: Quality = "good"
    reason: str = ""
    sensors: tuple[str, ...] = ()
    model: str = ""
    where: str = ""
    missing_share: float | None = None
    bounds: Mapping[str, tuple[float, float]] = field(default_factory=dict)

    @property
    def partial(self) -> bool:
        """Whether samples are missing, but not so many that nothing can be stated."""
        return self.quality == "missing" and bool(self.bounds)


NO_SAMPLES = ("no samples of stream ", "no more samples of stream ")
"""How a statement begins that nothing comes of a stream."""


def silence_reason(stream: str, silence_s: float, why: str = "", beside: str = "") -> str:
    """Why a statement about a silent stream is not good.

    Args:
        stream: its name.
        silence_s: how long nothing has come of it.
        why: what its bus states of that, in a clause; empty if it states nothing.
        beside: what else does not come, in a clause; empty if that is not known.
    """
    if why:
        return f"no samples of stream {stream!r}: {why}"
    also = f", and {beside}" if beside else ""
    return f"no samples of stream {stream!r} for more than {silence_s:.1f} s{also}; check bus and device"


def is_text(value: object, longest: int) -> bool:
    """Whether something is a text that can be sent and written down: UTF-8 without NUL, not too long."""
    if not isinstance(value, str) or len(value) > longest or "\0" in value:
        return False
    return not any("\ud800" <= character <= "\udfff" for character in value)
