"""Build probes and keyphasor from a machine file."""

from __future__ import annotations

from typing import TYPE_CHECKING

from daqsvc.dsp.probes import Probe
from daqsvc.dsp.quality.unit import UM_PER_UNIT
from daqsvc.dsp.speed.keyphasor import KeyphasorProbe
from daqsvc.settings.models import Keyphasor, ProximityProbe

if TYPE_CHECKING:
    from daqsvc.settings.models import MachineFile
    from daqsvc.settings.streams import Grid


def probes(machine: MachineFile, grid: Grid, names: tuple[str, str]) -> tuple[Probe, Probe]:
    """The two probes of a rotor, by the columns of the grid that its samples are on."""

    def probe(name: str) -> Probe:
        sensor = machine.sensor(name)
        assert isinstance(sensor, ProximityProbe)  # noqa: S101 - detectors/shaft/checks.py
        assert sensor.angle_deg is not None  # noqa: S101 - detectors/shaft/checks.py
        return Probe(name, grid.column(sensor), sensor.angle_deg, UM_PER_UNIT[sensor.unit])

    return probe(names[0]), probe(names[1])


def keyphasor(machine: MachineFile, grid: Grid, name: str) -> KeyphasorProbe:
    """A keyphasor, by its column of the grid that the samples are on."""
    sensor = machine.sensor(name)
    assert isinstance(sensor, Keyphasor)  # noqa: S101 - detectors/shaft/checks.py
    column = grid.column(sensor)
    return KeyphasorProbe(name, column, sensor.threshold_v, sensor.hysteresis_v, sensor.edge)
