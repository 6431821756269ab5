"""The table of the rotor's model bank: ``[pipeline.rotor_bank]``."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from daqsvc.settings.files import FilePath  # noqa: TC001 - pydantic reads the annotations
from daqsvc.settings.section import DampingRatio, Name, Nats, PositionUm, Section

Severity = Literal["normal", "alert", "danger"]

Fault = Literal["unbalance", "damping_loss", "static_load", "stiffness_loss", "rub"]

ROTOR_BANK = "rotor-bank"
"""Name of the rotor's model bank as a detector."""


class Mode(Section):
    """A state of the rotor that the bank has a model for: what differs from [machine.rotor], at one level."""

    name: Annotated[Name, Field(description="name of the mode", examples=["F1"])]
    severity: Annotated[Severity, Field(description="how bad the mode is", examples=["alert"])]
    fault: Fault | None = Field(
        default=None,
        description="the fault that the mode models; if absent, what differs from a healthy rotor decides",
        examples=["damping_loss"],
    )
    damping_ratio: DampingRatio | None = Field(
        default=None,
        description="damping ratio of the rotor in this mode; that of [machine.rotor] if absent",
        examples=[0.10],
    )
    unbalance_ratio: Annotated[float, Field(ge=0, le=1000)] = Field(
        default=1.0, description="eccentricity in this mode over that of the healthy rotor"
    )
    stiffness_ratio: Annotated[float, Field(ge=0.01, le=100)] = Field(
        default=1.0, description="stiffness of the shaft in this mode over that of the healthy one"
    )
    static_load_um: Annotated[tuple[PositionUm, PositionUm], Field(strict=False)] = Field(
        default=(0.0, 0.0), description="additional sag in this mode, towards +x and +y"
    )
    rub: bool = Field(default=False, description="whether the rotor can touch the stator in this mode")

    @property
    def differs(self) -> tuple[str, ...]:
        """Keys of the model that this mode sets, in the order of the file's format."""
        ordinary = {
            "unbalance_ratio": 1.0,
            "stiffness_ratio": 1.0,
            "static_load_um": (0.0, 0.0),
            "rub": False,
        }
        differing = [key for key, value in ordinary.items() if getattr(self, key) != value]
        return tuple(["damping_ratio", *differing] if self.damping_ratio is not None else differing)


ProcessNoise = Annotated[float, Field(ge=1e-12, le=1e6)]
Threshold = Annotated[float, Field(ge=0.1, le=1_000_000)]


class RotorBank(Section):
    """One observer per mode, and the rule that decides between them."""

    probes: Annotated[
        tuple[Name, Name],
        Field(strict=False, description="the two proximity probes", examples=['["probe-x", "probe-y"]']),
    ]
    keyphasor: Annotated[
        Name, Field(description="the keyphasor, which marks angle zero", examples=["keyphasor"])
    ]
    noise_um: Annotated[
        float,
        Field(ge=1e-3, le=10_000, description="standard deviation of the sensor noise", examples=[2.0]),
    ]
    process_noise: ProcessNoise | None = Field(
        default=None,
        description="PSD q of the linear observers, normalised; if not given, it is 0.0001, and less for a "
        "rotor with two modes whose orbit is small in its clearance",
        examples=[1e-4],
    )
    rub_process_noise: ProcessNoise = Field(default=0.1, description="PSD q3 of the rub observer, normalised")
    rule: Literal["cusum", "paper"] = Field(
        default="cusum", description="cusum raises alarms; paper shows probabilities only"
    )
    threshold_nats: Threshold = Field(default=16.0, description="evidence that declares a worse mode")
    back_threshold_nats: Threshold = Field(
        default=25.0, description="evidence that declares a healthier mode"
    )
    false_alarms_per_1000_rev: Annotated[float, Field(ge=1e-9, le=10_000)] | None = Field(
        default=None,
        description="false alarms that are accepted on a healthy machine, in place of threshold_nats",
        examples=[0.1],
    )
    mtbf_hours: Annotated[float, Field(ge=1e-3, le=1e9)] | None = Field(
        default=None,
        description="mean time between failures of the machine, in place of back_threshold_nats",
        examples=[20_000.0],
    )
    identity_nats: Nats = Field(
        default=3.0, description="lead over the other candidates that names the fault"
    )
    settle_revolutions: Annotated[float, Field(ge=0, le=1000)] = Field(
        default=0.0, description="how long a departure waits for its name; some 4 for many kinds of faults"
    )
    calibrate_revolutions: Annotated[int, Field(ge=0, le=100_000)] = Field(
        default=0,
        description="healthy revolutions that unbalance and sag are measured over; 0 trusts the file",
    )
    calibration: FilePath | None = Field(
        default=None,
        description="file of daqsvc calibrate with a run-up: the rotor's two modes as that shows them, in "
        "place of natural_frequency_hz, damping_ratio and eccentricity_um of [machine.rotor]",
        examples=["pump.calibration.toml"],
    )
    modes: Annotated[
        tuple[Mode, ...],
        Field(
            strict=False,
            min_length=2,
            max_length=64,
            description="the modes, healthy first",
            examples=['[{ name = "N", damping_ratio = 0.18, severity = "normal" }, ...]'],
        ),
    ]

    @property
    def sensors(self) -> tuple[Name, ...]:
        """The sensors that it rests on."""
        return (*self.probes, self.keyphasor)

    @property
    def sampled_together(self) -> tuple[Name, ...]:
        """The same, the keyphasor first: the grid is its samples, for edges are not to be interpolated."""
        return tuple(sorted(self.sensors, key=lambda name: name != self.keyphasor))
