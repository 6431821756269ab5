"""What a recording, its speed and its healthy run say against each other, in sentences for a person."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from daqsvc.analysis.acceleration import M_S2_PER_UNIT
from daqsvc.bearing.identify import NotIdentifiableError
from daqsvc.bearing.race.judge import race_test
from daqsvc.bearing.race.verdict import PLACES
from daqsvc.dsp.quality import UnfitError
from daqsvc.dsp.quality.clipped import ClippedError, refuse_clipped
from daqsvc.recording.errors import RecordingError

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from numpy.typing import NDArray

    from daqsvc.analysis.acceleration import AccelerationUnit
    from daqsvc.analysis.bearing_setup import BearingSetup
    from daqsvc.bearing.identify_baseline import BearingBaseline
    from daqsvc.bearing.race.verdict import RaceVerdict, RaceWord
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
_IMPOSSIBLE_M_S2 = (1e-4, 10_000.0)
"""Beyond, the unit is said to be wrong: `accelerometer_quality`."""


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
        if not (_IMPOSSIBLE_M_S2[0] <= m_s2 <= _IMPOSSIBLE_M_S2[1]) or _USUAL_G[0] <= g <= _USUAL_G[1]:
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


@dataclass(slots=True)
class HealthyRun:
    """A recording of the healthy machine, learnt anew for each sampling rate that is compared with it.

    Attributes:
        setup: what is known.
        recording: the healthy machine's.
    """

    setup: BearingSetup
    recording: Recording
    _learnt: dict[float, BearingBaseline] = field(default_factory=dict)
    _against: tuple[str, str] | None = None

    @property
    def against(self) -> tuple[str, str]:
        """What speaks against it as a healthy run, see `against_healthy_run`."""
        if self._against is None:
            self._against = against_healthy_run(self.recording, self.setup)
        return self._against

    def at(self, rate_hz: float) -> BearingBaseline:
        """The healthy machine at a sampling rate.

        Raises:
            NotIdentifiableError: it cannot be learnt at that rate.
        """
        if rate_hz not in self._learnt:
            self._learnt[rate_hz] = self.setup.learn(self.recording, rate_hz)
        return self._learnt[rate_hz]


def load_healthy(
    setup: BearingSetup, path: str, map_to: Mapping[str, str], rate_hz: float | None
) -> HealthyRun:
    """The healthy machine at a path; arguments as of `BearingSetup.load`.

    Raises:
        ValueError: it cannot be read, or cannot be the healthy machine's.
    """
    try:
        healthy = HealthyRun(setup, setup.load(path, map_to, rate_hz))
        healthy.at(healthy.recording.rate_hz)
    except (RecordingError, NotIdentifiableError) as error:
        raise ValueError(f"healthy run {path}: {error}") from error
    return healthy


def _judged(recording: Recording, name: str, setup: BearingSetup, speed_rpm: float) -> RaceVerdict | str:
    """The race test of a channel by itself, or why there is none."""
    column = recording.samples[:, recording.names.index(name)]
    column = np.where(np.isfinite(column), column, np.nan)
    try:
        refuse_clipped(column)
        return race_test(column, recording.rate_hz, speed_rpm, setup.bearings[name], setup.race)
    except (ClippedError, UnfitError) as error:
        return str(error)


def _place(word: RaceWord) -> str:
    """The part or the race that a verdict names."""
    return next((place for part, place in PLACES.items() if part == word), f"{word.replace('_', ' ')} race")
