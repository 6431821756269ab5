"""Whether samples can be in the unit that they are said to be in, by their size.

This is asked of recordings only. Live a sensor's unit stands in the machine file, where `daqsvc check` shows
what becomes of it, and a machine that stands still is as quiet as one in a wrong unit.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from daqsvc.dsp.quality import UnfitError

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from daqsvc.dsp.quality.recorded import DataQuality

    Floats = NDArray[np.float64]

_LEAST_ORBIT_UM = 0.01
_MOST_ORBIT_UM = 10_000.0
_MOST_CLEARANCES = 20.0
_LEAST_OF_CLEARANCE = 1e-3


def refuse_size(samples: Floats, clearance_um: float | None, unit: str) -> None:
    """Refuse orbits of a size that no rotor has: the unit must be wrong.

    Args:
        samples: float64 ``[n, 2]`` in um, NaN where missing.
        clearance_um: radial clearance, if known.
        unit: what the samples were said to be in.

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
    """Tell of an orbit so small in its clearance that the unit may be wrong.

    Args:
        quality: what is known so far.
        samples: float64 ``[n, 2]`` in um, NaN where missing.
        clearance_um: radial clearance, if known.
        unit: what the samples were said to be in.
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


def _wrong_unit(radius: str, unit: str) -> UnfitError:
    return UnfitError(
        "the orbit",
        f"has a radius of {radius}: the unit {unit!r} looks wrong",
        "correct --unit (m, mm, um or mil)",
    )
