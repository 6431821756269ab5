"""The levels of a recording: those of the live detectors, without a phase where it has no keyphasor."""

from __future__ import annotations

from typing import TYPE_CHECKING

from daqsvc.detectors.levels.settings import Levels
from daqsvc.diagnosis.recorded import RecordedLive

if TYPE_CHECKING:
    from collections.abc import Container


class RecordedLevels(RecordedLive[Levels]):
    """What the levels of a recording are; see `RecordedLive`."""

    def as_recorded(self, sensors: Container[str]) -> Levels | None:
        """See `RecordedDetector.as_recorded`: without its keyphasor all but the phases are left."""
        lacks = self.settings.keyphasor is not None and self.settings.keyphasor not in sensors
        return self.settings.model_copy(update={"keyphasor": None}) if lacks else self.settings
