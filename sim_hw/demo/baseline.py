"""What recordings are to the demo: setpoints from one of the healthy machine, and whether one can be played.

What no device could send, or nothing would come of, is refused.
"""

from __future__ import annotations

import re
from dataclasses import replace
from fractions import Fraction
from typing import TYPE_CHECKING

import numpy as np

from sim_hw.demo.errors import DemoError
from sim_hw.demo.machines import Setpoints

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from daqsvc.recording.recording import Recording


WINDOW_S = 0.5
ALERT = 1.5
DANGER = 3.0
"""Limits over the loudest window of the healthy machine."""

MOST_RATIO = 1000


def setpoints(healthy: Recording, rate_hz: float) -> Setpoints:
    """Alert and danger limits of the RMS of each channel.

    The healthy recording is first brought to the rate of the one it is compared with: at a higher rate
    it would hold vibration that the other cannot.

    Args:
        healthy: recording of the healthy machine.
        rate_hz: rate of the recording to come.

    Raises:
        DemoError: the recording is shorter than one window, or a channel of it does not move.
    """
    # Imported here: it takes over a second, and only --baseline needs it.
    from scipy.signal import resample_poly  # noqa: PLC0415

    ratio = Fraction(rate_hz / healthy.rate_hz).limit_denominator(MOST_RATIO)
    levels = Setpoints()
    for column, name in enumerate(healthy.names):
        samples: NDArray[np.float64] = healthy.samples[:, column]
        if np.ptp(samples) == 0.0:
            raise DemoError(
                f"baseline {healthy.source} does not move: every sample of {name} is {samples[0]:g}; "
                "give a recording of the running machine"
            )
        if ratio != 1:
            samples = resample_poly(samples - samples.mean(), ratio.numerator, ratio.denominator)
        size = round(WINDOW_S * rate_hz)
        count = len(samples) // size
        if not count:
            raise DemoError(
                f"baseline {healthy.source} lasts {len(samples) / rate_hz:.2f} s; give at least {WINDOW_S} s"
            )
        windows = samples[: count * size].reshape(count, size)
        loudest = float(windows.std(axis=1).max())
        levels[name] = (ALERT * loudest, DANGER * loudest)
    return levels


LONGEST_NAME = 64


def playable(recording: Recording) -> Recording:
    """The recording with names that sensors can have.

    Raises:
        DemoError: it holds NaN or infinite samples, is too short, or a name cannot be made a sensor's.
    """
    _check_samples(recording)
    duration_s = len(recording.samples) / recording.rate_hz
    if duration_s < WINDOW_S:
        raise DemoError(
            f"{recording.source} is too short: {len(recording.samples)} samples at {recording.rate_hz:g} Hz "
            f"last {duration_s:.3g} s; give at least {WINDOW_S} s, or correct --fs"
        )
    return replace(recording, names=_sensor_names(recording))


def _check_samples(recording: Recording) -> None:
    counted = [(recording.nan_count, "NaN"), (recording.infinity_count, "infinite")]
    if kinds := " and ".join(f"{count} {kind}" for count, kind in counted if count):
        holding = [
            name
            for column, name in enumerate(recording.names)
            if not np.isfinite(recording.samples[:, column]).all()
        ]
        raise DemoError(
            f"{recording.source} holds {kinds} samples (in {', '.join(holding)}), which no device could "
            "send; cut them out or interpolate them"
        )


def _sensor_names(recording: Recording) -> tuple[str, ...]:
    originals: dict[str, str] = {}
    for original in recording.names:
        name = re.sub(r"[^A-Za-z0-9_.-]+", "-", original).strip("-")
        remedy = "name its sensor with --map NAME=VARIABLE"
        if not name:
            raise DemoError(f"{recording.source}: no sensor can be named {original!r}; {remedy}")
        if len(name) > LONGEST_NAME:
            raise DemoError(
                f"{recording.source}: {name!r} is longer than the {LONGEST_NAME} characters of a sensor's "
                f"name; {remedy}"
            )
        if name in originals:
            raise DemoError(
                f"{recording.source}: {originals[name]!r} and {original!r} would both be sensor {name!r}; "
                f"{remedy}"
            )
        originals[name] = original
    return tuple(originals)
