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
from daqsvc.dsp.quality.recorded import count_bad
from daqsvc.recording.channels import M_S2_PER_UNIT

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from numpy.typing import NDArray

    from daqsvc.bearing.geometry import BearingOrders
    from daqsvc.bearing.race.verdict import RaceVerdict, RaceWord
    from daqsvc.detectors.bearing.verdict import BearingSetup
    from daqsvc.dsp.quality.recorded import DataQuality
    from daqsvc.recording.channels import AccelerationUnit
    from daqsvc.recording.recording import Recording

    Floats = NDArray[np.float64]

_RPM_NAME = re.compile(r"(?i)(?:.*[^a-z])?rpm|(?:.*[._])?(?:speed|shaft)_?rpm")
"""Names under which a file may state the speed: ``X105RPM``, ``rpm``, ``speed_rpm``."""
_SAME_SPEED = 0.03
_LIKE_HZ_RPM = 200.0
"""A speed below may be meant in revolutions per second."""
_G_M_S2 = 9.80665
_USUAL_G = (1e-3, 50.0)
"""R.m.s. of a housing on a running machine, at the least and at the most."""
_LEAST_M_S2 = 1e-4
_MOST_M_S2 = 10_000.0
"""No accelerometer on a housing shows less than its own noise, or more r.m.s. than destroys it."""
_LEAST_MACHINE_M_S2 = 1e-3
"""A tenth of a milli-g: what a good accelerometer shows by itself where nothing turns."""
_TWICE_TOLERANCE = 0.1


def stated_speed_problem(recording: Recording, speed_rpm: float) -> str:
    """What to say of a speed that the file states otherwise; empty if there is nothing to say."""
    stated = {name: rpm for name, rpm in recording.scalars.items() if _RPM_NAME.fullmatch(name) and rpm > 0.0}
    if not stated or any(abs(rpm / speed_rpm - 1.0) <= _SAME_SPEED for rpm in stated.values()):
        return ""
    said = " and ".join(f"{rpm:g} rpm ({name})" for name, rpm in stated.items())
    return f"{recording.source} states {said}, --speed-rpm is {speed_rpm:g}: correct the one that is wrong"


def unit_problems(recording: Recording, unit: AccelerationUnit) -> Iterator[str]:
    """What to say of channels that are possible, but quiet or loud for a running machine."""
    for name, column in zip(recording.names, recording.samples.T, strict=True):
        signal = column[np.isfinite(column)]
        m_s2 = float(signal.std()) * M_S2_PER_UNIT.get(unit, np.nan) if len(signal) else np.nan
        g = m_s2 / _G_M_S2
        if not (_LEAST_M_S2 <= m_s2 <= _MOST_M_S2) or _USUAL_G[0] <= g <= _USUAL_G[1]:
            continue
        how = "little" if g < 1.0 else "much"
        yield (
            f"{name}: {float(signal.std()):.3g} {unit} r.m.s. is {how} for a running machine: it was taken "
            f"to be in {unit}; correct --unit if it is not"
        )


def meant_in_hz(recording: Recording, setup: BearingSetup) -> str:
    """What to say of a speed that is that of the shaft in revolutions per second; empty if it is not."""
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
    """What speaks against a recording as the healthy run.

    Args:
        recording: said to be of the machine in good order.
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


def accelerometer_quality(names: Sequence[str], samples: Floats, unit: AccelerationUnit) -> DataQuality:
    """Count what is missing, and tell of sizes that no acceleration has; the race test tells of offsets.

    Args:
        names: of the channels.
        samples: float64 ``[n, channels]`` as they were recorded.
        unit: that they are said to be in.
    """
    quality = count_bad(names, samples)
    for name, column in zip(names, samples.T, strict=True):
        signal = column[np.isfinite(column)]
        if not len(signal):
            continue
        rms = float(signal.std())
        if np.ptp(signal) == 0.0:
            continue  # dead: the race test says so; the rounding of its mean is no vibration
        m_s2 = rms * M_S2_PER_UNIT.get(unit, float("nan"))
        if m_s2 < _LEAST_M_S2 or m_s2 > _MOST_M_S2:
            quality = quality.with_problem(
                f"{name}: vibrates with {rms:.3g} {unit} r.m.s., which no housing does: the unit looks "
                "wrong; correct --unit (g, m/s2 or V)"
            )
    return quality


def refuse_no_machine(samples: Floats, unit: AccelerationUnit, race: RaceVerdict) -> None:
    """Refuse a channel that shows no machine at all, as of a sensor that is unplugged.

    Args:
        samples: ``[n]``, as they were recorded.
        unit: that they are said to be in.
        race: what the race test says of them.

    Raises:
        UnfitError: they are quieter than any machine, and no harmonics of a shaft stand out.
    """
    rms = float(np.nanstd(samples))
    quiet = rms * M_S2_PER_UNIT.get(unit, float("nan")) < _LEAST_MACHINE_M_S2
    if quiet and not race.speed_seen and race.verdict == "normal":
        raise UnfitError(
            "channel",
            f"shows no machine: {rms:.3g} {unit} r.m.s. and no speed that its harmonics confirm",
            "check sensor, cable and --unit",
        )


def ball_order_problem(orders: BearingOrders) -> str:
    """What is odd about a stated BSF; empty if nothing: BPFI and BPFO alone determine it.

    Their sum is the number of balls, their difference over it the ratio of ball to pitch diameter, times the
    cosine of the contact angle, which makes BSF smaller by itself; so only about twice the value is told.

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
    column = np.where(np.isfinite(column), column, np.nan)
    try:
        refuse_clipped(column)
        return race_test(column, recording.rate_hz, speed_rpm, setup.bearings[name], setup.race)
    except UnfitError as error:
        return str(error)


def _place(word: RaceWord) -> str:
    """The part or the race that a verdict names."""
    return next((place for part, place in PLACES.items() if part == word), f"{word.replace('_', ' ')} race")
