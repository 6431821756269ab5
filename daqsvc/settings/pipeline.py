"""What is computed from the samples: level detectors and the rotor's model bank."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import AfterValidator, Field
from pydantic_core import PydanticCustomError

from daqsvc.settings.section import DampingRatio, Name, Positive, Section

Severity = Literal["normal", "alert", "danger"]

ROTOR_BANK = "rotor-bank"
"""Name of the rotor's model bank as a detector."""


def _ordered_band(band_hz: tuple[float, float]) -> tuple[float, float]:
    low_hz, high_hz = band_hz
    if not 0 < low_hz < high_hz:
        raise PydanticCustomError(
            "band_order",
            "is not a band: it needs 0 < lower edge < upper edge, in Hz",
            {"remedy": "write e.g. [10.0, 1000.0]"},
        )
    return band_hz


class Levels(Section):
    """RMS, peak, crest factor and velocity RMS of every vibration sensor, window by window."""

    window_s: Annotated[Positive, Field(le=600)] = Field(default=0.5, description="length of a window")
    velocity_band_hz: Annotated[tuple[float, float], AfterValidator(_ordered_band), Field(strict=False)] = (
        Field(default=(10.0, 1000.0), description="band of the velocity RMS (ISO 20816-3: 10 Hz to 1000 Hz)")
    )


class Mode(Section):
    """A state of the rotor that the bank has a model for."""

    name: Annotated[Name, Field(description="name of the mode", examples=["F1"])]
    damping_ratio: Annotated[DampingRatio, Field(description="the rotor's damping in it", examples=[0.1])]
    severity: Annotated[Severity, Field(description="how bad it is", examples=["alert"])]
    rub: bool = Field(default=False, description="whether the rotor touches the stator in it")


class RotorBank(Section):
    """One observer per mode, and the rule that decides between them."""

    probes: Annotated[
        tuple[Name, Name],
        Field(strict=False, description="the two proximity probes", examples=['["probe-x", "probe-y"]']),
    ]
    keyphasor: Annotated[Name, Field(description="the keyphasor", examples=["keyphasor"])]
    noise_um: Annotated[Positive, Field(description="standard deviation of the sensor noise", examples=[2.0])]
    process_noise: Positive = Field(default=1e-4, description="PSD q of the linear observers, normalised")
    rub_process_noise: Positive = Field(default=0.1, description="PSD q3 of the rub observer, normalised")
    rule: Literal["cusum", "paper"] = Field(
        default="cusum", description="cusum raises alarms; paper shows probabilities only"
    )
    threshold_nats: Positive = Field(default=16.0, description="evidence that declares a worse mode")
    back_threshold_nats: Positive = Field(default=25.0, description="evidence that declares a healthier mode")
    modes: Annotated[
        tuple[Mode, ...],
        Field(
            strict=False,
            min_length=2,
            description="the modes, healthy first",
            examples=['[{ name = "N", damping_ratio = 0.18, severity = "normal" }, ...]'],
        ),
    ]


class Pipeline(Section):
    """The detectors, and how much of the past they can reach."""

    ring_s: Annotated[Positive, Field(le=3600)] = Field(
        default=30.0, description="length of each stream's ring"
    )
    levels: Levels | None = Field(default=None, description="level detectors")
    rotor_bank: RotorBank | None = Field(default=None, description="the rotor's model bank")
