"""A detector whose alarm is raised where the crest factor of an acceleration reaches a setpoint."""

from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import Field

from daqsvc.api import DetectorPlugin, Finding, Judgement, MachineFile, Name, Section, WindowDetector, choice


class Crest(Section):
    """The table [pipeline.crest]."""

    sensor: Annotated[Name, Field(description="the accelerometer", examples=["accel-de"])]
    alert: Annotated[float, Field(ge=1, le=1000)] = Field(default=6.0, description="the setpoint")


class CrestDetector(WindowDetector):
    """Peak over RMS of each second."""

    def __init__(self, machine: MachineFile, settings: Crest) -> None:
        super().__init__(machine, "crest", [settings.sensor], window_s=1.0)
        self._alert = settings.alert

    def judge(self, samples: np.ndarray) -> Judgement:
        """Whether the crest factor is at the setpoint; a sensor that stands still has none."""
        x = samples - samples.mean()
        crest = float(np.abs(x).max() / x.std()) if x.any() else 0.0
        figures, limits = {"crest_factor": crest}, {"crest_factor.alert": self._alert}
        return Judgement("alert" if crest >= self._alert else "normal", figures, thresholds=limits)


class CrestPlugin(DetectorPlugin[Crest]):
    """Knocks in an acceleration."""

    settings, about, detector = Crest, "impacts in an acceleration", "crest"

    def checks(self, draft: MachineFile, settings: Crest) -> Iterator[Iterator[Finding]]:
        """There is such a sensor."""
        names = [sensor.name for sensor in draft.sensors]
        if settings.sensor not in names:
            at = ("pipeline", "crest", "sensor")
            yield iter([Finding(at, "there is no such sensor", choice(settings.sensor, names))])

    def build(self, machine: MachineFile, settings: Crest, _store: Path | None) -> list[CrestDetector]:
        """One detector."""
        return [CrestDetector(machine, settings)]
