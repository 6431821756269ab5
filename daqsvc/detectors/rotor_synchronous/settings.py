"""The calibrated rotor: what is watched of it, and how sure an alarm must be."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from daqsvc.settings.files import FilePath  # noqa: TC001 - pydantic reads the annotations
from daqsvc.settings.section import Name, Section

ROTOR_SYNCHRONOUS = "rotor-synchronous"
"""Name of the calibrated rotor as a detector."""

SpeedSource = Literal["keyphasor", "fixed", "orbit"]

Percent = Annotated[float, Field(ge=0, lt=100)]


class RotorSynchronous(Section):
    """The rotor against its own healthy state: mean position, 1X and 2X of every revolution."""

    probes: Annotated[
        tuple[Name, Name],
        Field(strict=False, description="the two proximity probes", examples=['["probe-x", "probe-y"]']),
    ]
    keyphasor: Name | None = Field(
        default=None, description="the keyphasor, if there is one", examples=["keyphasor"]
    )
    speed_source: SpeedSource | None = Field(
        default=None,
        description="what tells the shaft angle: keyphasor; fixed, machine.speed_rpm is exact; orbit, the 1X "
        "itself, around machine.speed_rpm. The keyphasor if there is one, else fixed",
        examples=["orbit"],
    )
    calibrate_revolutions: Annotated[int, Field(ge=20, le=10_000)] = Field(
        default=50,
        description="first revolutions, which are the healthy state without calibration; kept over restarts",
    )
    calibration: FilePath | None = Field(
        default=None,
        description="file of daqsvc calibrate: the rotor, and the healthy state in place of the first "
        "revolutions unless it holds a run-up only",
        examples=["pump.calibration.toml"],
    )
    false_alarms_per_1000_rev: Annotated[float, Field(ge=1e-9, le=10)] = Field(
        default=0.1, description="false alarms that are accepted on a healthy machine"
    )
    natural_frequency_tolerance_percent: Percent = Field(
        default=20.0, description="how far off machine.rotor.natural_frequency_hz may be"
    )
    damping_tolerance_percent: Percent = Field(
        default=20.0, description="how far off machine.rotor.damping_ratio may be"
    )
    probe_drift_um: Annotated[float, Field(ge=0, le=100_000)] = Field(
        default=0.0, description="change of the mean position that is the probes' own, with temperature"
    )

    @property
    def reference(self) -> SpeedSource:
        """What gives the shaft angle, stated or implied."""
        if self.speed_source is not None:
            return self.speed_source
        return "fixed" if self.keyphasor is None else "keyphasor"

    @property
    def sensors(self) -> tuple[Name, ...]:
        """The sensors that it rests on."""
        if self.keyphasor is None or self.reference != "keyphasor":
            return self.probes
        return (*self.probes, self.keyphasor)

    @property
    def sampled_together(self) -> tuple[Name, ...]:
        """The same, the keyphasor first: the grid is its samples, for edges are not to be interpolated."""
        return tuple(sorted(self.sensors, key=lambda name: name != self.keyphasor))
