"""Which variable of a recording is which channel, at what rate and in what unit."""

from __future__ import annotations

import argparse
import math
from typing import TYPE_CHECKING, TypeAlias

from daqsvc.confined.limits import GIGABYTE
from daqsvc.dsp.quality.unit import LENGTH_UNITS, UM_PER_UNIT
from daqsvc.recording import RecordingError

if TYPE_CHECKING:
    from collections.abc import Callable

    import numpy as np
    from numpy.typing import NDArray

    Floats: TypeAlias = NDArray[np.float64]

LEAST_MEMORY_GB = 0.05
MOST_MEMORY_GB = 1000.0

LEAST_RATE_HZ = 1.0
MOST_RATE_HZ = 10e6
"""Sampling rates outside of these are mistakes: a rate in kHz, or a period in its place."""


def channel_map(text: str) -> dict[str, str]:
    """``NAME=VARIABLE,...``: what each channel is called from now on, and in the file (for argparse).

    Raises:
        argparse.ArgumentTypeError: it is not of this form, or names a channel twice.
    """
    pairs = [pair.partition("=") for pair in text.split(",")]
    found: dict[str, str] = {}
    for name, _, variable in pairs:
        if not (name.strip() and variable.strip()):
            raise argparse.ArgumentTypeError(
                f"{text!r} is not a map; write NAME=VARIABLE, several with commas between"
            )
        if name.strip() in found:
            raise argparse.ArgumentTypeError(
                f"{text!r} names {name.strip()!r} twice; give each channel a name of its own"
            )
        found[name.strip()] = variable.strip()
    return found


def sampling_rate_hz(text: str) -> float:
    """A sampling rate that a recording may have (for argparse).

    Raises:
        argparse.ArgumentTypeError: it is not a number from `LEAST_RATE_HZ` to `MOST_RATE_HZ`.
    """
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not LEAST_RATE_HZ <= value <= MOST_RATE_HZ:
        raise argparse.ArgumentTypeError(
            f"{text!r} is not a sampling rate from {LEAST_RATE_HZ:g} to {MOST_RATE_HZ:,.0f} Hz"
        )
    return value


def memory_limit(text: str) -> int:
    """Memory in GB that reading a recording may take, in bytes (for argparse).

    Raises:
        argparse.ArgumentTypeError: it is not a number from `LEAST_MEMORY_GB` to `MOST_MEMORY_GB`.
    """
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not LEAST_MEMORY_GB <= value <= MOST_MEMORY_GB:
        raise argparse.ArgumentTypeError(
            f"{text!r} is not a number of GB from {LEAST_MEMORY_GB:g} to {MOST_MEMORY_GB:g}"
        )
    return round(value * GIGABYTE)


def add_max_memory(add: Callable[..., argparse.Action]) -> None:
    """The option ``--max-memory``; what it says goes to `daqsvc.recording.recording.set_limits`.

    Args:
        add: ``add_argument`` of the group that takes it.
    """
    add(
        "--max-memory",
        type=memory_limit,
        metavar="GB",
        help="memory that reading one recording may take (default: half of the machine's, at most 4)",
    )


def metres_per_unit(unit: str) -> float:
    """Length of one ``unit`` in m.

    Raises:
        RecordingError: the unit is none of `LENGTH_UNITS`.
    """
    return _um_per(unit) / 1e6


def to_um(lengths: Floats, unit: str) -> Floats:
    """Lengths in ``unit`` as lengths in um, float64 of the same shape.

    Raises:
        RecordingError: the unit is none of `LENGTH_UNITS`.
    """
    return lengths * _um_per(unit)


def _um_per(unit: str) -> float:
    if unit not in UM_PER_UNIT:
        raise RecordingError(f"{unit!r} is not a unit of length; use {', '.join(LENGTH_UNITS)}")
    return UM_PER_UNIT[unit]
