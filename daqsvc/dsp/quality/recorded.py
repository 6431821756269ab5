"""What is known against a recording as a whole, before it is judged and after.

The detector judges each revolution of a recording as it does live (`daqsvc.dsp.quality.probes`). Here a
recording of probes is refused besides that has a few revolutions which stand still or are clipped: it can be
cut, or taken again, and whoever asks is there to do it. Live a detector leaves them out and goes on.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Protocol, TypedDict

import numpy as np

from daqsvc.confined.spilled import let_go
from daqsvc.dsp.quality import RefusedError, UnfitError
from daqsvc.dsp.quality.clipped import (
    CLIPPED_REVOLUTION,
    LEAST_CUT_OFF,
    LEAST_IN_REVOLUTION,
    clipped_at,
    ends_cut_off,
)
from daqsvc.dsp.quality.missing import RECORDING_SHARE
from daqsvc.rounding import counted_are

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from numpy.typing import NDArray

    from daqsvc.dsp.quality.missing import EdgeCounts

    Floats = NDArray[np.float64]

_LEAST_BAD_REVOLUTIONS = 3
"""Number of still or clipped revolutions from which on this is no chance."""
_NO_MEAN = 1e-3
"""A mean position within this part of the 1X amplitude is none."""
_FIGURES = re.compile(r"[-+]?\d[\d.]*(?:e[-+]?\d+)?")


OFF_STATED = 0.015
"""Share by which the speed may differ from the stated one until that is reported; it is stated to 1 %."""


def off_stated_speed(seen_rpm: float, stated_rpm: float) -> str:
    """The note about a speed by the harmonics of the shaft that is not the stated one; empty if it is.

    Args:
        seen_rpm: by harmonics that stand out clearly.
        stated_rpm: what was stated of the machine.
    """
    off = abs(seen_rpm / stated_rpm) - 1.0
    if abs(off) <= OFF_STATED:
        return ""
    return (
        f"the harmonics of the shaft stand out at {abs(seen_rpm):.1f} rpm, not at the stated "
        f"{abs(stated_rpm):g} rpm ({100.0 * off:+.1f} %): the former is used; correct the speed"
    )


class KeyphasorJson(TypedDict):
    """The pulses of the keyphasor.

    Attributes:
        accepted: pulses that were used.
        missing: pulses that are not there.
        rejected: pulses that were left out.
    """

    accepted: int
    missing: int
    rejected: int


class DataQualityJson(TypedDict):
    """What is known against the samples.

    Attributes:
        samples: how many there are of a channel.
        missing: samples that are not there, by channel.
        infinite: samples that are infinite, by channel; they count as missing.
        clipped: samples at the end of the probe's range in clipped revolutions, by channel.
        unusable_revolutions: revolutions that could not be fitted.
        keyphasor: its pulses; null without one.
        problems: what a person should know, in sentences.
    """

    samples: int
    missing: dict[str, int]
    infinite: dict[str, int]
    clipped: dict[str, int]
    unusable_revolutions: int
    keyphasor: KeyphasorJson | None
    problems: list[str]


@dataclass(frozen=True, slots=True)
class DataQuality:
    """What is known against the samples.

    Attributes:
        samples: of a channel.
        missing: samples that are not there (NaN), by channel.
        infinite: samples that are infinite, by channel; they count as missing.
        clipped: samples at the end of the probe's range in clipped revolutions, by channel.
        unusable_revolutions: revolutions that could not be fitted.
        keyphasor: what became of its pulses; None without one.
        problems: what a person should know, in sentences.
    """

    samples: int
    missing: Mapping[str, int] = field(default_factory=dict)
    infinite: Mapping[str, int] = field(default_factory=dict)
    clipped: Mapping[str, int] = field(default_factory=dict)
    unusable_revolutions: int = 0
    keyphasor: EdgeCounts | None = None
    problems: tuple[str, ...] = ()

    def with_problem(self, problem: str) -> DataQuality:
        """The same with one more problem."""
        return replace(self, problems=(*self.problems, problem))

    def joined(self, other: DataQuality) -> DataQuality:
        """The same with what is known against channels of another rate."""
        return replace(
            self,
            missing={**self.missing, **other.missing},
            infinite={**self.infinite, **other.infinite},
            clipped={**self.clipped, **other.clipped},
            problems=tuple(dict.fromkeys((*self.problems, *other.problems))),
        )

    def as_json(self) -> DataQualityJson:
        """For the output."""
        marks = self.keyphasor
        return {
            "samples": self.samples,
            "missing": dict(self.missing),
            "infinite": dict(self.infinite),
            "clipped": dict(self.clipped),
            "unusable_revolutions": self.unusable_revolutions,
            "keyphasor": None
            if marks is None
            else {"accepted": marks.accepted, "missing": marks.missing, "rejected": marks.rejected},
            "problems": list(self.problems),
        }


_BLOCK = 1 << 18
"""Samples of a channel that are read at a time."""


def count_bad(names: Sequence[str], samples: Floats) -> DataQuality:
    """Missing and infinite samples by channel.

    Args:
        names: of the channels.
        samples: float64 ``[n, channels]`` as they were recorded.
    """
    missing, infinite = np.zeros(len(names), np.int64), np.zeros(len(names), np.int64)
    for begin in range(0, len(samples), _BLOCK):
        block = samples[begin : begin + _BLOCK]
        missing += np.isnan(block).sum(axis=0)
        infinite += np.isinf(block).sum(axis=0)
        let_go(samples)
    quality = DataQuality(
        len(samples),
        missing=dict(zip(names, missing.tolist(), strict=True)),
        infinite=dict(zip(names, infinite.tolist(), strict=True)),
        clipped=dict.fromkeys(names, 0),
    )
    for name in names:
        if quality.infinite[name]:
            quality = quality.with_problem(
                f"{name}: {counted_are(quality.infinite[name], 'infinite sample')} taken as missing"
            )
    return quality


class _Channels(Protocol):
    """What is examined of a `daqsvc.recording.recording.Recording`."""

    @property
    def names(self) -> Sequence[str]:
        """Of the channels."""
        ...

    @property
    def samples(self) -> Floats:
        """Float64 ``[n, channels]``."""
        ...

    @property
    def notes(self) -> Sequence[str]:
        """What was odd about the file."""
        ...


def known_against(recording: _Channels) -> DataQuality:
    """What is known against a recording before anybody looks at its signals."""
    quality = count_bad(recording.names, recording.samples)
    return replace(quality, problems=(*recording.notes, *quality.problems))


def refuse_unreadable(names: Sequence[str], samples: Floats) -> None:
    """Refuse channels without any reading, and probes that never move.

    Args:
        names: of the channels.
        samples: float64 ``[n, channels]``, NaN where missing.

    Raises:
        UnfitError: a channel holds nothing, or one value only.
    """
    for name, signal in zip(names, samples.T, strict=True):
        there = signal[np.isfinite(signal)]
        if len(there) <= len(signal) * (1.0 - RECORDING_SHARE):
            raise UnfitError(
                f"{name}:",
                f"{len(signal) - len(there)} of {len(signal)} samples are missing or infinite, more "
                "than half",
                "repair the recording, or map another channel with --map",
            )
        if float(there.min()) == float(there.max()):
            raise UnfitError(
                name, f"is dead: all samples are {there[0]:.6g}", "check the probe, its cable and driver"
            )


def refuse_stuck(
    quality: DataQuality, probes: Sequence[str], samples: Floats, period_samples: float
) -> DataQuality:
    """Refuse probes that stand still or are clipped, revolution by revolution.

    Args:
        quality: what is known so far.
        probes: names of the probes.
        samples: float64 ``[n, probes]`` in um, NaN where missing.
        period_samples: samples per revolution.

    Returns:
        The quality with the clipped samples counted, and reported if they are few.

    Raises:
        UnfitError: a probe repeats one value through whole revolutions, or is clipped in some.
    """
    revolution = max(4, round(period_samples))
    count = len(samples) // revolution
    for column, name in enumerate(probes):
        signal = np.ascontiguousarray(samples[: count * revolution, column]).reshape(count, revolution)
        there = np.isfinite(signal)
        low = np.where(there, signal, np.inf).min(axis=1, initial=np.inf)
        high = np.where(there, signal, -np.inf).max(axis=1, initial=-np.inf)
        seen = there.sum(axis=1)
        still = np.flatnonzero((low == high) & (seen > revolution // 2))
        if len(still) >= _LEAST_BAD_REVOLUTIONS:
            first = int(still[0])
            raise UnfitError(
                name,
                f"is dead in {len(still)} of {count} revolutions, the first is revolution {first + 1} "
                f"(all samples are {low[first]:.6g} um)",
                "check the probe, its cable and driver, or give only "
                f"the {first * revolution} samples before",
            )
        at_end = np.maximum(
            (signal == low[:, np.newaxis]).sum(axis=1), (signal == high[:, np.newaxis]).sum(axis=1)
        )
        suspects = np.flatnonzero(at_end >= max(LEAST_IN_REVOLUTION, CLIPPED_REVOLUTION * revolution))
        clipped = [(int(i), at) for i in suspects if (at := clipped_at(signal[i][there[i]])) is not None]
        if len(clipped) >= _LEAST_BAD_REVOLUTIONS:
            samples_at = sum(int((signal[i] == at).sum()) for i, at in clipped)
            first, at = clipped[0]
            raise ClippedProbeError(
                name,
                f"is clipped at {at:.6g} um in {len(clipped)} of {count} revolutions, the first is "
                f"revolution {first + 1}",
                "check the gap and the range of the converter",
                replace(quality, clipped={**quality.clipped, name: samples_at}),
            )
        quality = _peaks_cut_off(quality, name, samples[:, column])
    return quality


def _peaks_cut_off(quality: DataQuality, name: str, signal: Floats) -> DataQuality:
    """Report a probe whose highest or lowest peaks all end at one value, now and then."""
    ends = ends_cut_off(signal, LEAST_CUT_OFF)
    if not ends:
        return quality
    clipped = {**quality.clipped, name: sum(ends.values())}
    at = " and ".join(f"{value:.6g} um" for value in ends)
    return replace(quality, clipped=clipped).with_problem(
        f"{name} is clipped now and then: {counted_are(sum(ends.values()), 'sample')} at {at}; check the gap "
        "and the range of the converter"
    )


class ClippedProbeError(UnfitError):
    """A probe is clipped.

    Args:
        name: of the probe.
        value: what was found.
        remedy: what to do about it.
        quality: what is known, with the clipped samples counted.
    """

    def __init__(self, name: str, value: str, remedy: str, quality: DataQuality) -> None:
        super().__init__(name, value, remedy)
        self.quality = quality


def refuse_gaps(unusable: int, revolutions: int, complaints: Sequence[Complaint]) -> None:
    """Refuse a recording most revolutions of which cannot be judged.

    Args:
        unusable: revolutions that cannot.
        revolutions: all of them.
        complaints: of the detector.

    Raises:
        RefusedError: more than half of them, or there is none at all.
    """
    if not revolutions:
        raise UnfitError("no whole revolution", "was found", "check the speed and the keyphasor")
    if unusable > RECORDING_SHARE * revolutions:
        why = max(complaints, key=lambda one: one.times).reason if complaints else "samples are missing"
        raise RefusedError(f"{why} ({unusable} of {revolutions} revolutions cannot be judged)")


@dataclass(slots=True)
class Complaint:
    """What a detector complained of.

    Attributes:
        reason: in its words, of the first time.
        times: how often it was so.
    """

    reason: str
    times: int = 0

    def describe(self) -> str:
        """As a problem of the recording."""
        again = self.times - 1
        if not again:
            return self.reason
        return f"{self.reason} (and {again} {'time' if again == 1 else 'times'} more)"


def complaints(reasons: Iterable[str]) -> tuple[Complaint, ...]:
    """Complaints by kind, as they came: those that differ in figures only are of one.

    Args:
        reasons: in order.
    """
    kinds: dict[str, Complaint] = {}
    for reason in reasons:
        kinds.setdefault(_FIGURES.sub("", reason), Complaint(reason)).times += 1
    return tuple(kinds.values())


def lacks_mean(samples: Floats) -> bool:
    """Whether both probes swing about zero in the end, as AC-coupled ones do.

    The first half does not count: AC coupling answers switching on with a transient that takes time to decay.

    Args:
        samples: float64 ``[n, 2]`` in um, NaN where missing.
    """
    later = samples[len(samples) // 2 :]
    if not np.isfinite(later).any(axis=0).all():
        return False
    mean, deviation = np.nanmean(later, axis=0), np.nanstd(later, axis=0)
    # Noise leaves something of a mean even where there is none.
    allowed = math.sqrt(2.0) * deviation * _NO_MEAN + 3.0 * deviation / math.sqrt(len(later))
    return bool((np.abs(mean) < allowed).all())
