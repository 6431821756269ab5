"""From the channels of a stream to the shaft's revolutions: orbit, angle and synchronous vector of each."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal, TypeAlias

import numpy as np

from daqsvc.dsp.probes import Probe, probes_to_xy, shaft_axes_deg
from daqsvc.dsp.speed.keyphasor import KeyphasorProbe
from daqsvc.dsp.speed.revolutions import FixedSpeedCutter, KeyphasorCutter, OrbitCutter, Revolutions
from daqsvc.rotor.synchronous.vectors import SynchronousVectors, synchronous_vectors

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    from daqsvc.dsp.quality.missing import EdgeCounts
    from daqsvc.dsp.speed.revolutions import RevolutionCutter

    Floats = NDArray[np.float64]

SpeedReference: TypeAlias = KeyphasorProbe | Literal["fixed", "orbit"]
"""What gives the shaft angle: a keyphasor, the stated speed, or the orbit's own 1X around it."""

_SETTLED = 12
"""Revolutions of a keyphasor until each of its edges is placed by those around it. Before, an edge may lie
anywhere between two samples, and 1X turns with it."""
_MIN_PROBE_SPREAD = 0.5
"""Least |sin| of the angle between the probes: 30 degrees apart they still see both axes."""


@dataclass(frozen=True, slots=True)
class Revolution:
    """One revolution of the shaft.

    Attributes:
        raw: float64 ``[n, 2]``, what the probes measure, in um; NaN where missing.
        orbit: the revolution alone, in um along x and y. Its angle goes on through the mark where the
            revolution does not begin at the mark.
        vector: its synchronous vector; the end is counted from the first sample of the stream.
        trusted: whether the angle is known.
        settled: whether it is known as well as it ever is: a keyphasor has given edges for a while.
    """

    raw: Floats
    orbit: Revolutions
    vector: SynchronousVectors
    trusted: bool
    settled: bool = True

    def unusable(self) -> Revolution:
        """The same revolution without anything that could be judged."""
        nothing = np.full((1, 5), np.nan, dtype=np.complex128)
        return replace(
            self,
            orbit=replace(self.orbit, xy=np.full_like(self.orbit.xy, np.nan)),
            vector=replace(self.vector, vectors=nothing, noise=np.full(1, np.nan)),
        )

    def without_mean(self) -> Revolution:
        """The same revolution about its mean position."""
        vectors = self.vector.vectors.copy()
        mean = complex(vectors[0, 0])
        vectors[0, 0] -= mean
        return replace(
            self,
            orbit=replace(self.orbit, xy=self.orbit.xy - (mean.real, mean.imag)),
            vector=replace(self.vector, vectors=vectors),
        )


class RevolutionStream:
    """Cuts a stream into revolutions, over gaps as well.

    A shaft that turns clockwise is viewed from its other end (x mirrored): its whirl is then forward, and
    gravity still points down.

    Args:
        machine: name of the machine, for messages.
        rate_hz: sampling rate.
        speed_rpm: stated speed; negative if the shaft turns clockwise.
        probes: two proximity probes.
        reference: what gives the shaft angle.

    Raises:
        ValueError: a figure cannot be, or the probes look in nearly the same direction.
    """

    def __init__(
        self,
        *,
        machine: str,
        rate_hz: float,
        speed_rpm: float,
        probes: tuple[Probe, Probe],
        reference: SpeedReference,
    ) -> None:
        if not (math.isfinite(speed_rpm) and speed_rpm != 0.0 and math.isfinite(rate_hz) and rate_hz > 0.0):
            raise ValueError(
                f"rotor of {machine!r}: a speed of {speed_rpm} rpm sampled at {rate_hz} Hz cannot be "
                "followed; both must be finite, the rate above 0 and the speed not 0"
            )
        spread = math.sin(math.radians(probes[1].angle_deg - probes[0].angle_deg))
        if abs(spread) < _MIN_PROBE_SPREAD:
            raise ValueError(
                f"rotor of {machine!r}: {probes[0].name!r} at {probes[0].angle_deg} and "
                f"{probes[1].name!r} at {probes[1].angle_deg} degrees look in nearly the same direction; "
                "the orbit needs two probes 30 to 150 degrees apart"
            )
        self.period = 60.0 * rate_hz / abs(speed_rpm)
        self.clockwise = speed_rpm < 0.0
        self.sensors: tuple[Probe | KeyphasorProbe, ...] = probes
        if isinstance(reference, KeyphasorProbe):
            self.sensors = (*probes, reference)
        self.axes_deg = shaft_axes_deg((probes[0].angle_deg, probes[1].angle_deg), clockwise=self.clockwise)
        self._reference = reference
        self._columns = [sensor.column for sensor in self.sensors]
        self._um_per_unit = np.array([probe.um_per_unit for probe in probes])
        self._to_xy = probes_to_xy(self.axes_deg)
        self._cutter = self._new_cutter()
        self.origin = 0
        """Absolute index of the first sample."""
        self.end_index = 0
        """One past the absolute index of the last sample."""
        self._started = False
        self._begin_cutting(0)

    @property
    def edges(self) -> EdgeCounts:
        """What became of the keyphasor's pulses."""
        return self._cutter.counts

    @property
    def waiting_samples(self) -> int:
        """Samples that no revolution has come out of yet."""
        return len(self._held)

    def process(
        self, samples: NDArray[np.float32], first_index: int, *, broken: bool = False
    ) -> list[Revolution]:
        """Take in samples; the revolutions that they complete.

        A gap of up to a revolution is bridged as missing samples. After a longer one, where the index goes
        back, and after a break the revolutions begin again; at a stated speed the angle goes on.

        Args:
            samples: float32 ``[n, channels]`` of the stream; what is not finite is missing.
            first_index: absolute index of the first one.
            broken: whether it is a guess how far that is from the samples before.
        """
        values = np.asarray(samples, dtype=np.float64)[:, self._columns]
        values = np.where(np.isfinite(values), values, np.nan)
        if not self._started:
            self._started, self.origin = True, first_index
            self._begin_cutting(first_index)
        elif not broken and 0 < (gap := first_index - self.end_index) <= self.period:
            values = np.concatenate((np.full((gap, values.shape[1]), np.nan), values))
            first_index -= gap
        elif broken or gap:
            self._begin_cutting(first_index)
        self.end_index = first_index + len(values)
        return list(self._cut(values))

    def _new_cutter(self) -> RevolutionCutter:
        if self._reference == "fixed":
            return FixedSpeedCutter(self.period)
        if self._reference == "orbit":
            return OrbitCutter(self.period)
        return KeyphasorCutter(
            threshold=self._reference.threshold_v,
            hysteresis=self._reference.hysteresis_v,
            period_samples=self.period,
            edge=self._reference.edge,
        )

    def _begin_cutting(self, first_index: int) -> None:
        self._cutter.reset()
        self._cutter_index = self._held_index = first_index
        self._held = np.empty((0, 2))
        self._since_begin = 0

    def _cut(self, values: Floats) -> Iterator[Revolution]:
        probes = values[:, :2] * self._um_per_unit
        marker = values[:, 2] if isinstance(self._reference, KeyphasorProbe) else None
        revolutions = self._cutter.process(probes @ self._to_xy, marker)
        self._held = np.concatenate((self._held, probes))
        if not len(revolutions):
            return
        begin = self._cutter_index + revolutions.first_index - self._held_index
        raw, self._held = np.split(self._held, [begin + len(revolutions.xy)])
        self._held_index += len(raw)
        since = self._cutter_index - self.origin
        if self._reference == "fixed":
            # After a gap the cutter begins at angle zero again; the shaft does not.
            angle = math.tau * math.fmod(since / self.period, 1.0)
            revolutions = replace(revolutions, angle_rad=revolutions.angle_rad + angle)
        vectors = synchronous_vectors(revolutions)
        vectors = replace(vectors, end_index=vectors.end_index + since)
        ends = [*revolutions.starts[1:].tolist(), len(revolutions.xy)]
        for i, (start, end) in enumerate(zip(revolutions.starts.tolist(), ends, strict=True)):
            orbit = Revolutions(
                first_index=revolutions.first_index + start + since,
                xy=revolutions.xy[start:end],
                angle_rad=revolutions.angle_rad[start:end],
                starts=np.zeros(1, dtype=np.int64),
                period_samples=revolutions.period_samples[i : i + 1],
                trusted=revolutions.trusted[i : i + 1],
            )
            trusted = bool(revolutions.trusted[i])
            self._since_begin = self._since_begin + 1 if trusted else 0
            settled = marker is None or self._since_begin > _SETTLED
            yield Revolution(raw[begin + start : begin + end], orbit, vectors[i : i + 1], trusted, settled)
