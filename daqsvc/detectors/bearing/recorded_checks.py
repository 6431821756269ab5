"""What a person should know of a recording of accelerometers, of its speed and of its healthy run."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

import numpy as np

from daqsvc.bearing.race.judge import race_test
from daqsvc.bearing.race.verdict import PLACES
from daqsvc.dsp.quality import UnfitError
from daqsvc.dsp.quality.accelerometers import OFFSET_NOTE
from daqsvc.dsp.quality.clipped import refuse_clipped
from daqsvc.dsp.quality.recorded import off_stated_speed

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from daqsvc.bearing.geometry import BearingOrders
    from daqsvc.bearing.race.verdict import RaceVerdict, RaceWord
    from daqsvc.detectors.bearing.verdict import BearingSetup
    from daqsvc.dsp.quality.recorded import DataQuality
    from daqsvc.recording.recording import Recording

    Floats = NDArray[np.float64]

_RPM_NAME = re.compile(r"(?i)(?:.*[^a-z])?rpm|(?:.*[._])?(?:speed|shaft)_?rpm")
"""Names under which a file may state the speed: ``X105RPM``, ``rpm``, ``speed_rpm``."""
_SAME_SPEED = 0.03
_LIKE_HZ_RPM = 200.0
"""A speed below may be meant in revolutions per second."""
_TWICE_TOLERANCE = 0.1


def stated_speed_problem(recording: Recording, speed_rpm: float) -> str:
    """The note about a speed that the file states otherwise; empty if there is none."""
    stated = {name: rpm for name, rpm in recording.scalars.items() if _RPM_NAME.fullmatch(name) and rpm > 0.0}
    if not stated or any(abs(rpm / speed_rpm - 1.0) <= _SAME_SPEED for rpm in stated.values()):
        return ""
    speeds = " and ".join(f"{rpm:g} rpm ({name})" for name, rpm in stated.items())
    return f"{recording.source} states {speeds}, --speed-rpm is {speed_rpm:g}: correct the one that is wrong"


def meant_in_hz(recording: Recording, setup: BearingSetup) -> str:
    """The note about a speed that is that of the shaft in revolutions per second; empty if it is not."""
    meant_rpm = 60.0 * setup.speed_rpm
    if setup.speed_rpm > _LIKE_HZ_RPM:
        return ""
    for name in recording.names:
        race = _judged(recording, name, setup, meant_rpm)
        if isinstance(race, str) or not race.speed_seen:
            continue
        return (
            f"--speed-rpm {setup.speed_rpm:g} looks like revolutions per second: harmonics of the shaft "
            f"stand out at {race.speed_rpm:.0f} rpm; give --speed-rpm {meant_rpm:g}"
        )
    return ""


def against_healthy_run(recording: Recording, setup: BearingSetup) -> tuple[str, str]:
    """The evidence against a recording as the healthy run.

    Args:
        recording: stated to be of the machine in good order.
        setup: what is known.

    Returns:
        The damage that it shows, and why its speed is in doubt; empty where there is nothing.
    """
    damage, doubt = "", ""
    for name in recording.names:
        race = _judged(recording, name, setup, setup.speed_rpm)
        if isinstance(race, str):
            doubt = doubt or f"{name}: {race}"
        elif race.verdict != "normal":
            damage = damage or f"{name} shows damage of the {_place(race.verdict)}"
        elif not race.speed_seen:
            doubt = (
                doubt
                or f"{name}: its harmonics do not confirm {setup.speed_rpm:g} rpm at {recording.rate_hz:g} Hz"
            )
    return damage, doubt


def ball_order_problem(orders: BearingOrders) -> str:
    """What is odd about a stated BSF; empty if nothing: BPFI and BPFO alone determine it.

    Their sum is the number of balls, their difference over it the ratio of ball to pitch diameter, times the
    cosine of the contact angle, which makes BSF smaller by itself. So only about twice the value is reported.

    Args:
        orders: as stated.
    """
    balls = max(round(orders.inner + orders.outer), 1)
    ratio = (orders.inner - orders.outer) / balls
    expected = (1.0 - ratio**2) / (2.0 * ratio)
    if abs(orders.ball / (2.0 * expected) - 1.0) > _TWICE_TOLERANCE:
        return ""
    return (
        f"BSF {orders.ball:g} is twice what BPFI {orders.inner:g} and BPFO {orders.outer:g} make it "
        f"({expected:.3f}): some data sheets state 2 BSF; give half of it"
    )


def with_repairs(quality: DataQuality, races: Mapping[str, RaceVerdict]) -> DataQuality:
    """The same with what the race test found wrong with the samples and put right.

    Args:
        quality: what is known so far.
        races: what each channel shows, of those that could be judged.
    """
    for name, race in races.items():
        for repair in race.repairs:
            quality = quality.with_problem(f"{name}: {repair}")
    return with_offsets(quality, races)


def with_speed(quality: DataQuality, races: Mapping[str, RaceVerdict], stated_rpm: float) -> DataQuality:
    """The same with a speed that the harmonics of the shaft show, where it is not the stated one.

    Args:
        quality: what is known so far.
        races: what each channel shows, of those that could be judged.
        stated_rpm: the speed that was stated.
    """
    for race in races.values():
        if race.speed_seen and (problem := off_stated_speed(race.speed_rpm, stated_rpm)):
            return quality.with_problem(problem)
    return quality


def with_offsets(quality: DataQuality, races: Mapping[str, RaceVerdict]) -> DataQuality:
    """The same with the offsets that the race test met.

    Args:
        quality: what is known so far.
        races: what each channel shows, of those that could be judged.
    """
    for name, race in races.items():
        for note in race.notes:
            if note.startswith(OFFSET_NOTE):
                quality = quality.with_problem(f"{name}: {note}; check the sensor's supply")
    return quality


def _judged(recording: Recording, name: str, setup: BearingSetup, speed_rpm: float) -> RaceVerdict | str:
    """The race test of a channel by itself, or why there is none."""
    column = recording.samples[:, recording.names.index(name)]
    column = np.where(np.isfinite(column), column, np.nan).astype(np.float64, copy=False)
    try:
        refuse_clipped(column)
        return race_test(column, recording.rate_hz, speed_rpm, setup.bearings[name], setup.race)
    except UnfitError as error:
        return str(error)


def _place(word: RaceWord) -> str:
    """The part or the race that a verdict names."""
    return next((place for part, place in PLACES.items() if part == word), f"{word.replace('_', ' ')} race")
