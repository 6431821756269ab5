"""Whether a recording can be played: what no device could send, or nothing would come of, is refused."""

from __future__ import annotations

import re
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from sim_hw.demo.baseline import WINDOW_S
from sim_hw.demo.errors import DemoError

if TYPE_CHECKING:
    from daqsvc.recording.recording import Recording

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
    found: dict[str, str] = {}
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
        if name in found:
            raise DemoError(
                f"{recording.source}: {found[name]!r} and {original!r} would both be sensor {name!r}; "
                f"{remedy}"
            )
        found[name] = original
    return tuple(found)
