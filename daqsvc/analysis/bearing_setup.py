"""What has to be known about bearings before a recording of them can be judged, and how one is read."""

from __future__ import annotations

import fnmatch
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from daqsvc.bearing.identify_baseline import BearingBaseline, learn_baseline, resampled
from daqsvc.bearing.identify_change import ChangeRules
from daqsvc.bearing.race.rules import RaceRules
from daqsvc.recording.errors import RecordingError
from daqsvc.recording.recording import list_channels, load_recording

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from numpy.typing import NDArray

    from daqsvc.analysis.acceleration import AccelerationUnit
    from daqsvc.bearing.geometry import BearingOrders
    from daqsvc.recording.recording import Recording

    Floats = NDArray[np.float64]

MOST_CHANNELS = 2


@dataclass(frozen=True, slots=True, kw_only=True)
class BearingSetup:
    """What `analyse_bearings` needs to know.

    Attributes:
        channels: accelerometers on the bearings' housings, one or two.
        speed_rpm: shaft speed, right to about 1 %.
        bearings: fault orders of the bearing at each channel.
        designations: of the bearings; those that were given by their orders have none.
        unit: of the samples; ``"V"`` if the sensors' sensitivity is not known.
        map: what a channel is called in the file, where that is not its name here.
        rate_hz: samples per second; None: what the file says.
        change: what counts as a change of the healthy machine.
        race: settings of the race test.
    """

    channels: tuple[str, ...]
    speed_rpm: float
    bearings: Mapping[str, BearingOrders]
    designations: Mapping[str, str] = field(default_factory=dict)
    unit: AccelerationUnit = "g"
    map: Mapping[str, str] = field(default_factory=dict)
    rate_hz: float | None = None
    change: ChangeRules = field(default_factory=ChangeRules)
    race: RaceRules = field(default_factory=RaceRules)

    def load(
        self, path: str, map_to: Mapping[str, str] | None = None, rate_hz: float | None = None
    ) -> Recording:
        """Read the channels of a recording.

        Args:
            path: the file.
            map_to: what the channels are called in it, in place of ``map``.
            rate_hz: its sampling rate, in place of ``rate_hz``.

        Raises:
            RecordingError: it cannot be read.
        """
        names = self.map if map_to is None else {**self.map, **map_to}
        wanted = {name: names.get(name, name) for name in self.channels}
        rate_hz = self.rate_hz if rate_hz is None else rate_hz
        try:
            return load_recording(path, wanted, rate_hz)
        except RecordingError:
            found = _found(path, wanted)
            if found == wanted:
                raise
        return load_recording(path, found, rate_hz)

    def learn(self, recording: Recording, rate_hz: float | None = None) -> BearingBaseline:
        """The healthy machine of a recording.

        Args:
            recording: of the healthy machine.
            rate_hz: rate of the recordings that are compared with it; None: its own.

        Raises:
            NotIdentifiableError: it cannot be the healthy machine's.
        """
        samples, highest = resampled(
            recording.samples, recording.rate_hz, recording.rate_hz if rate_hz is None else rate_hz
        )
        samples = np.where(np.isfinite(samples), samples, np.nan)
        return learn_baseline(
            dict(zip(recording.names, samples.T, strict=True)),
            recording.rate_hz if rate_hz is None else rate_hz,
            self.speed_rpm,
            self.bearings,
            [(name,) for name in self.channels] + [self.channels] * (len(self.channels) > 1),
            highest=highest,
            source=str(recording.source),
        )


def _found(path: str, wanted: Mapping[str, str]) -> dict[str, str]:
    """Channels of a file by name, by a pattern, or by what only one of its names ends with."""
    there = list_channels(path)
    return {name: matching(path, variable, there) for name, variable in wanted.items()}


def matching(path: str, variable: str, there: Iterable[str]) -> str:
    """The channel of a file that a name means, or a pattern, or what only one of the names there ends with.

    Sets of recordings often number their variables: ``DE_time`` is ``X105_DE_time`` in one file and
    ``X106_DE_time`` in the next.

    Args:
        path: the file.
        variable: what is meant.
        there: the channels of the file.

    Returns:
        The channel; ``variable`` itself if there is none.

    Raises:
        RecordingError: several may be meant.
    """
    matches = [one for one in there if one.endswith(variable) or fnmatch.fnmatchcase(one, variable)]
    if not matches or variable in matches:
        return variable
    if len(matches) > 1:
        raise RecordingError(
            f"{path} has several channels that may be {variable!r}: {', '.join(matches)}; name one of them"
        )
    return matches[0]
