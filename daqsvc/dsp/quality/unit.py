"""Units of recordings, and whether samples can be in the one that is stated, by their size.

This is asked of recordings only. Live, a sensor's unit is in the machine file, where `daqsvc check` shows
what becomes of it, and a machine that stands still is as quiet as one in a wrong unit. What no sensor
measures in any unit is refused live as well (`beyond_any_unit`), before arithmetic with it overflows.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal, get_args

import numpy as np

from daqsvc.confined.spilled import let_go
from daqsvc.dsp.quality import UnfitError
from daqsvc.dsp.quality.recorded import count_bad

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from numpy.typing import NDArray

    from daqsvc.dsp.quality.recorded import DataQuality

    Floats = NDArray[np.float64]

LengthUnit = Literal["m", "mm", "um", "mil"]

LENGTH_UNITS: tuple[LengthUnit, ...] = get_args(LengthUnit)

UM_PER_UNIT: Mapping[str, float] = {"m": 1e6, "mm": 1e3, "um": 1.0, "mil": 25.4}

AccelerationUnit = Literal["g", "m/s2", "mg", "mm/s2", "V"]

ACCELERATION_UNITS: tuple[AccelerationUnit, ...] = get_args(AccelerationUnit)

M_S2_PER_UNIT: Mapping[str, float] = {"g": 9.80665, "m/s2": 1.0, "mg": 9.80665e-3, "mm/s2": 1e-3}
"""Of standard gravity (CGPM 1901). Volts are missing: what they mean only the sensor's sensitivity shows."""

_USUAL_G = (1e-3, 50.0)
"""R.m.s. of a housing on a running machine, at the least and at most."""
_LEAST_M_S2 = 1e-4
_MOST_M_S2 = 10_000.0
"""No accelerometer on a housing shows less than its own noise, or more r.m.s. than destroys it."""
_LEAST_MACHINE_M_S2 = 1e-3
"""A tenth of a milli-g: what a good accelerometer shows by itself where nothing turns."""
MOST_IN_ANY_UNIT = 1e12
"""A larger value no sensor measures, in whatever unit: in micrometres it is a thousand kilometres."""
_LEAST_SWING = 1e-12
"""Nor does any resolve less of a signal than this, from its lowest value to its highest."""
_LEAST_VALUE = float(np.finfo(np.float32).tiny)
"""Single values nearer to 0, and not 0, are other bits read as a float."""
_LEAST_ORBIT_UM = 0.01
_MOST_ORBIT_UM = 10_000.0
_MOST_CLEARANCES = 20.0
_LEAST_OF_CLEARANCE = 1e-3


def to_um(lengths: Floats, unit: str) -> Floats:
    """Lengths in ``unit`` as lengths in um, float64 of the same shape.

    Raises:
        ValueError: the unit is none of `LENGTH_UNITS`.
    """
    if unit not in UM_PER_UNIT:
        raise ValueError(f"{unit!r} is not a unit of length; use {', '.join(LENGTH_UNITS)}")
    return lengths * UM_PER_UNIT[unit]


def within_some_unit(signals: NDArray[np.floating]) -> bool:
    """Whether all of what signals hold is finite, and no more than some sensor measures in some unit.

    Args:
        signals: of any shape.
    """
    least, most = (signals.min(), signals.max()) if signals.size else (np.nan, np.nan)
    return bool(least >= -MOST_IN_ANY_UNIT and most <= MOST_IN_ANY_UNIT)


def beyond_any_unit(signal: NDArray[np.floating]) -> str:
    """What of a signal no sensor can have measured, whatever its unit; empty if nothing.

    Args:
        signal: ``[n]``; what is not finite does not count.
    """
    # It costs a third of what states where, and leaves nothing to report of nearly every signal.
    if within_some_unit(signal):
        return ""
    far = (signal > MOST_IN_ANY_UNIT) | (signal < -MOST_IN_ANY_UNIT)
    wrong = np.flatnonzero(far & np.isfinite(signal))
    if not len(wrong):
        return ""
    first = int(wrong[0])
    return (
        f"holds {signal[first]:.4g} at sample {first} ({len(wrong)} of {len(signal)} samples are beyond "
        f"{MOST_IN_ANY_UNIT:g}), which no sensor measures in any unit"
    )


def beyond_any_value(values: NDArray[np.floating]) -> str:
    """What of values that stand each by itself no sensor can have measured; empty if nothing.

    Args:
        values: ``[n]``; what is not finite does not count.
    """
    if wrong := beyond_any_unit(values):
        return wrong
    small = np.flatnonzero((np.abs(values) < _LEAST_VALUE) & (values != 0.0))
    if not len(small):
        return ""
    return f"holds {values[small[0]]:.4g} at sample {small[0]}, which no sensor resolves in any unit"


RESCALE = "correct its scale or unit, or replace the file or the device that is broken"


def refuse_beyond_any_unit(signal: NDArray[np.floating], sensor: str = "channel") -> None:
    """Refuse a signal that holds what no sensor measures, in whatever unit.

    Args:
        signal: ``[n]``; what is not finite does not count.
        sensor: what it is called.

    Raises:
        UnfitError: it does.
    """
    if wrong := beyond_any_unit(signal):
        raise UnfitError(sensor, wrong, RESCALE)


def refuse_still(signal: Floats) -> None:
    """Refuse a signal that moves, but by less than any sensor resolves, in whatever unit.

    Args:
        signal: ``[n]``, with a finite value; what is not finite does not count.

    Raises:
        UnfitError: it is such a signal.
    """
    there = signal[np.isfinite(signal)]
    swing = float(np.ptp(there))
    if 0.0 < swing < _LEAST_SWING:
        raise UnfitError(
            "channel", f"moves by {swing:.4g} in all, which no sensor resolves in any unit", RESCALE
        )


def refuse_size(samples: Floats, clearance_um: float | None, unit: str) -> None:
    """Refuse orbits of a size that no rotor has: the unit must be wrong.

    Args:
        samples: float64 ``[n, 2]`` in um, NaN where missing.
        clearance_um: radial clearance, if known.
        unit: the stated unit of the samples.

    Raises:
        UnfitError: the orbit is too small or too large.
    """
    radius_um = _radius_um(samples)
    most_um = _MOST_ORBIT_UM
    than = f"{most_um / 1000:g} mm"
    if clearance_um is not None and _MOST_CLEARANCES * clearance_um < most_um:
        most_um = _MOST_CLEARANCES * clearance_um
        than = f"{_MOST_CLEARANCES:g} times the clearance of {clearance_um:g} um"
    if radius_um > most_um:
        raise _wrong_unit(f"{radius_um:.3g} um, more than {than}", unit)
    if radius_um < _LEAST_ORBIT_UM:
        raise _wrong_unit(f"{radius_um:.3g} um, less than {_LEAST_ORBIT_UM:g} um", unit)


def doubt_size(quality: DataQuality, samples: Floats, clearance_um: float | None, unit: str) -> DataQuality:
    """Report an orbit so small in its clearance that the unit may be wrong.

    Args:
        quality: what is known so far.
        samples: float64 ``[n, 2]`` in um, NaN where missing.
        clearance_um: radial clearance, if known.
        unit: the stated unit of the samples.
    """
    radius_um = _radius_um(samples)
    if clearance_um is None or radius_um >= _LEAST_OF_CLEARANCE * clearance_um:
        return quality
    return quality.with_problem(
        f"the unit {unit!r} may be wrong: the orbit has a radius of {radius_um:.2g} um in a clearance of "
        f"{clearance_um:.4g} um"
    )


def _radius_um(samples: Floats) -> float:
    spread = np.nanpercentile(samples, [1.0, 99.0], axis=0)
    return float((spread[1] - spread[0]).max()) / 2.0


def accelerometer_quality(names: Sequence[str], samples: Floats, unit: AccelerationUnit) -> DataQuality:
    """Count what is missing, and report sizes that no acceleration has; the race test reports offsets.

    Args:
        names: of the channels.
        samples: float64 ``[n, channels]`` as they were recorded.
        unit: their stated unit.
    """
    quality = count_bad(names, samples)
    for name, column in zip(names, samples.T, strict=True):
        rms, swing = _spread(column)
        if not np.isfinite(rms):
            continue
        if swing == 0.0:
            continue  # dead: the race test states it; the rounding of its mean is no vibration
        m_s2 = rms * M_S2_PER_UNIT.get(unit, float("nan"))
        if m_s2 < _LEAST_M_S2 or m_s2 > _MOST_M_S2:
            quality = quality.with_problem(
                f"{name}: vibrates with {rms:.3g} {unit} r.m.s., which no housing does: the unit looks "
                "wrong; correct --unit (g, m/s2, mg, mm/s2 or V)"
            )
    return quality


def unit_problems(names: Sequence[str], samples: Floats, unit: AccelerationUnit) -> Iterator[str]:
    """The note about accelerometers that are possible, but quiet or loud for a running machine.

    Args:
        names: of the channels.
        samples: float64 ``[n, channels]`` as they were recorded.
        unit: their stated unit.
    """
    for name, column in zip(names, samples.T, strict=True):
        rms, _ = _spread(column)
        m_s2 = rms * M_S2_PER_UNIT.get(unit, np.nan)
        g = m_s2 / M_S2_PER_UNIT["g"]
        if not (_LEAST_M_S2 <= m_s2 <= _MOST_M_S2) or _USUAL_G[0] <= g <= _USUAL_G[1]:
            continue
        how = "little" if g < 1.0 else "much"
        yield (
            f"{name}: {rms:.3g} {unit} r.m.s. is {how} for a running machine: it was taken "
            f"to be in {unit}; correct --unit if it is not"
        )


_BLOCK = 1 << 18


def _spread(column: NDArray[np.floating]) -> tuple[float, float]:
    """Standard deviation and swing of what is finite of a column, block by block; NaN if nothing is."""

    def blocks() -> Iterator[Floats]:
        for begin in range(0, len(column), _BLOCK):
            block = column[begin : begin + _BLOCK].astype(np.float64)
            let_go(column)
            yield block[np.isfinite(block)]

    count = sum(len(block) for block in blocks())
    if not count:
        return float("nan"), float("nan")
    mean = sum(float(block.sum()) for block in blocks()) / count
    square = sum(float(np.square(block - mean).sum()) for block in blocks()) / count
    most = max(float(block.max()) for block in blocks() if len(block))
    least = min(float(block.min()) for block in blocks() if len(block))
    return float(np.sqrt(square)), most - least


def refuse_no_machine(samples: Floats, unit: AccelerationUnit, *, seen: bool) -> None:
    """Refuse a channel that shows no machine at all, as of a sensor that is unplugged.

    Args:
        samples: ``[n]``, as they were recorded.
        unit: their stated unit.
        seen: whether damage, or harmonics of a shaft, stand out.

    Raises:
        UnfitError: they are quieter than any machine, and nothing of one stands out.
    """
    rms = float(np.nanstd(samples))
    quiet = rms * M_S2_PER_UNIT.get(unit, float("nan")) < _LEAST_MACHINE_M_S2
    if quiet and not seen:
        raise UnfitError(
            "channel",
            f"shows no machine: {rms:.3g} {unit} r.m.s. and no speed that its harmonics confirm",
            "check sensor, cable and --unit",
        )


def _wrong_unit(radius: str, unit: str) -> UnfitError:
    return UnfitError(
        "the orbit",
        f"has a radius of {radius}: the unit {unit!r} looks wrong",
        "correct --unit (m, mm, um or mil)",
    )
