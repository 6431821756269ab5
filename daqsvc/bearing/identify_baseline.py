"""The healthy machine as its bearings' detectors remember it: what they compare with, from one recording."""

from __future__ import annotations

from dataclasses import dataclass, field
from fractions import Fraction
from typing import TYPE_CHECKING, TypeAlias

import numpy as np

from daqsvc.bearing.identify import NotIdentifiableError
from daqsvc.bearing.identify_change import HIGHEST, HealthyResidual, learn_healthy
from daqsvc.bearing.race.judge import race_baseline
from daqsvc.bearing.two_sensors import learn_pair
from daqsvc.dsp.quality import UnfitError

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from daqsvc.bearing.geometry import BearingOrders
    from daqsvc.bearing.race.baseline import RaceBaseline
    from daqsvc.bearing.two_sensors import HealthyPair, PairModel

    Floats: TypeAlias = NDArray[np.float64]

_RESAMPLED_HIGHEST = 0.4
"""Of the new rate: above, the filter of the resampling is not the recorder's."""
_MOST_RATIO = 1000


@dataclass(frozen=True, slots=True, kw_only=True)
class BearingBaseline:
    """A machine in good order.

    Attributes:
        rate_hz: sampling rate.
        speed_rpm: stated speed of the shaft.
        residuals: innovations of one accelerometer, or of several together, by their names.
        races: lines and levels of each bearing, by the name of its accelerometer.
        pairs: what accelerometers on rotor and housing show together, by their names in that order.
        source: the recording it comes from.
        written: label of the date, ISO 8601; empty if not known.
    """

    rate_hz: float
    speed_rpm: float
    residuals: Mapping[tuple[str, ...], HealthyResidual]
    races: Mapping[str, RaceBaseline]
    pairs: Mapping[tuple[str, ...], HealthyPair] = field(default_factory=dict)
    source: str = ""
    written: str = ""


def learn_baseline(
    samples: Mapping[str, Floats],
    rate_hz: float,
    speed_rpm: float,
    bearings: Mapping[str, BearingOrders],
    together: Sequence[tuple[str, ...]],
    *,
    pairs: Mapping[tuple[str, ...], PairModel] | None = None,
    highest: float = HIGHEST,
    source: str = "",
) -> BearingBaseline:
    """Learn the healthy machine.

    Args:
        samples: float64 ``[n]`` of each accelerometer, NaN where missing.
        rate_hz: sampling rate.
        speed_rpm: stated speed of the shaft.
        bearings: fault orders of the bearing at each accelerometer that has one.
        together: accelerometers whose innovations are modelled together.
        pairs: bearings with an accelerometer on rotor and housing, by the names of these in that order.
        highest: where the bands of the innovations end, as a part of the sampling rate.
        source: what the recording is called.

    Raises:
        NotIdentifiableError: the recording cannot be the healthy machine's; the message names the channels.
    """
    residuals: dict[tuple[str, ...], HealthyResidual] = {}
    races: dict[str, RaceBaseline] = {}
    healthy_pairs: dict[tuple[str, ...], HealthyPair] = {}
    names: tuple[str, ...] = ()
    try:
        for name, orders in bearings.items():
            names = (name,)
            races[name] = race_baseline(samples[name], rate_hz, speed_rpm, orders)
        for names in together:
            columns = np.column_stack([samples[name] for name in names])
            residuals[names] = learn_healthy(columns, rate_hz, highest=highest)
        for names, model in (pairs or {}).items():
            columns = np.column_stack([samples[name] for name in names]) * model.m_s2_per_unit
            healthy_pairs[names] = learn_pair(model.parameters, rate_hz, columns)
    except (NotIdentifiableError, UnfitError, ValueError) as error:
        raise NotIdentifiableError(f"{', '.join(names)}: {error}") from None
    return BearingBaseline(
        rate_hz=rate_hz,
        speed_rpm=speed_rpm,
        residuals=residuals,
        races=races,
        pairs=healthy_pairs,
        source=source,
    )


def resampled(samples: Floats, rate_hz: float, to_hz: float) -> tuple[Floats, float]:
    """A faster recording at a slower rate, and where its bands must end then, as a part of that rate.

    Args:
        samples: float64 ``[n]``.
        rate_hz: its rate.
        to_hz: the rate that is wanted.

    Raises:
        NotIdentifiableError: it is slower than that, or there is no simple ratio between the two.
    """
    if to_hz == rate_hz:
        return samples, HIGHEST
    ratio = Fraction(to_hz / rate_hz).limit_denominator(_MOST_RATIO)
    if to_hz > rate_hz or abs(float(ratio) * rate_hz / to_hz - 1.0) > 1e-6:
        raise NotIdentifiableError(
            f"the healthy machine was sampled at {rate_hz:g} Hz and cannot be compared at {to_hz:g} Hz; "
            f"give a recording of it at {to_hz:g} Hz, or a whole multiple"
        )
    from scipy.signal import resample_poly  # noqa: PLC0415 - costs a second that few callers need

    return np.asarray(resample_poly(samples, ratio.numerator, ratio.denominator)), _RESAMPLED_HIGHEST
