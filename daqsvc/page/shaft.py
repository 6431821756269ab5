"""What two probes and a keyphasor show of the shaft's centre: positions, revolutions, and its order 1X."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from daqsvc.dsp.probes import probes_to_xy, shaft_axes_deg
from daqsvc.dsp.speed.keyphasor import EdgeFinder

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from daqsvc.page.machine_live import MachineLive

    Floats = NDArray[np.float64]

MOST_OFF = 0.2
"""A mark that is so far from where it should be, in revolutions, is none."""
UM = {"um": 1.0, "mm": 1000.0, "m": 1e6, "mil": 25.4, "in": 25_400.0}
"""Micrometres in a unit of length."""


class Whirl(NamedTuple):
    """The shaft's centre over some revolutions.

    Attributes:
        xy_um: ``[n, 2]``, on the machine's axes; NaN where samples are missing.
        marks: samples at which the keyphasor marks a revolution, and their fractions; ``[m]``.
        rate_hz: samples per second.
        end_ns: when the last sample was taken.
        speed_hz: revolutions per second.
        has_keyphasor: whether angles count from its marks.
    """

    xy_um: Floats
    marks: Floats
    rate_hz: float
    end_ns: int
    speed_hz: float
    has_keyphasor: bool


class Order(NamedTuple):
    """The order 1X of the shaft's centre.

    Attributes:
        mean_um: ``[2]``, where the centre is on average.
        vectors_um: complex ``[2]``, peak amplitudes along x and y. Their angle is minus that by which the
            peak comes behind the keyphasor's mark; without a keyphasor, behind the first sample.
    """

    mean_um: Floats
    vectors_um: NDArray[np.complex128]

    def ellipse_um(self, points: int = 128) -> Floats:
        """The orbit of 1X alone, ``[points, 2]``, from the mark on; closed."""
        turns = np.exp(2j * np.pi * np.linspace(0.0, 1.0, points))[:, None]
        return np.asarray(self.mean_um + (self.vectors_um * turns).real)


def whirl(live: MachineLive, probes: tuple[str, str], revolutions: float) -> Whirl | None:
    """The last revolutions of the shaft; None if nothing of it has come.

    Args:
        live: the machine.
        probes: two of its proximity probes that are sampled together.
        revolutions: how many, as far as there are so many.
    """
    key = live.keyphasor()
    places = live.place_of([*probes, key]) if key else None
    has_keyphasor = places is not None
    places = places or live.place_of(probes)
    speed_hz = abs(live.speed_rpm) / 60.0
    if places is None or speed_hz == 0.0:
        return None
    stream = places[0].stream
    newest = live.newest(stream, revolutions / speed_hz)
    if newest is None or not len(newest[0]):
        return None
    samples, end_ns = newest
    columns = samples[:, [places[0].column, places[1].column]].astype(np.float64)
    sensors = [live.sensors[name] for name in probes]
    columns *= [UM.get(one.unit, 1.0) for one in sensors]
    angles = (sensors[0].angle_deg or 0.0, sensors[1].angle_deg or 0.0)
    xy = columns @ probes_to_xy(shaft_axes_deg(angles, clockwise=live.turns_clockwise))
    marks = np.empty(0)
    if has_keyphasor and key is not None:
        pulses = samples[:, places[2].column].astype(np.float64)
        probe = live.sensors[key]
        finder = EdgeFinder(probe.threshold or 0.0, probe.hysteresis, probe.edge)
        marks = np.array([index + fraction for index, fraction in finder.find(pulses)])
    return Whirl(xy, marks, live.rate_hz(stream), end_ns, speed_hz, has_keyphasor and len(marks) > 0)


def order_1x(seen: Whirl) -> Order | None:
    """1X by least squares over all samples; None if they are too few.

    By two marks or more the speed is theirs, over these samples; else the stated one.
    """
    index = np.arange(len(seen.xy_um), dtype=np.float64)
    mark, period = _turning(seen)
    turns = (index - mark) / period
    there = np.isfinite(seen.xy_um).all(axis=1)
    if there.sum() < 8 or np.ptp(turns[there]) < 0.9:
        return None
    wave = np.exp(2j * np.pi * turns[there])
    design = np.column_stack([np.ones(there.sum()), wave.real, -wave.imag])
    (mean, real, imaginary), *_ = np.linalg.lstsq(design, seen.xy_um[there], rcond=None)
    return Order(mean, real + 1j * imaginary)


def _turning(seen: Whirl) -> tuple[float, float]:
    """A sample at which the mark passes, and the samples of a revolution.

    Marks may be missing, and there may be some too many: each counts as many revolutions on as it comes
    behind the last one, by the usual distance.
    """
    expected = seen.rate_hz / seen.speed_hz
    if len(seen.marks) < 2:
        return (float(seen.marks[0]) if len(seen.marks) else 0.0), expected
    usual = float(np.median(np.diff(seen.marks)))
    kept, number = [float(seen.marks[0])], [0]
    for mark in seen.marks[1:]:
        turns = (float(mark) - kept[-1]) / usual
        if round(turns) >= 1 and abs(turns - round(turns)) <= MOST_OFF * round(turns):
            kept.append(float(mark))
            number.append(number[-1] + round(turns))
    if len(kept) < 2:
        return kept[0], expected
    period, first = np.polyfit(number, kept, 1)
    return float(first), float(period)
