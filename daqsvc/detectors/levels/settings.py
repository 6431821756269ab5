"""The table of the level detectors: ``[pipeline.levels]``."""

from __future__ import annotations

from typing import Annotated

from pydantic import AfterValidator, Field
from pydantic_core import PydanticCustomError

from daqsvc.errors.machine_file import WRONG_ORDER
from daqsvc.settings.measures import ISO_BAND_HZ, ListedMeasure, shows_1x
from daqsvc.settings.section import Name, Section


def _ordered_band(band_hz: tuple[float, float]) -> tuple[float, float]:
    low_hz, high_hz = band_hz
    if not 0 < low_hz < high_hz:
        raise PydanticCustomError(
            "band_order",
            "is not a band: it needs 0 < lower edge < upper edge, in Hz",
            {"remedy": "write e.g. [10.0, 1000.0]", "code": WRONG_ORDER},
        )
    return band_hz


BandHz = Annotated[float, Field(ge=0.001, le=5_000_000)]


class Levels(Section):
    """RMS, peak, crest factor and velocity RMS of every vibration sensor, window by window."""

    window_s: Annotated[float, Field(ge=1e-3, le=600)] = Field(
        default=0.5, description="length of the windows that levels are measured over"
    )
    velocity_band_hz: Annotated[tuple[BandHz, BandHz], AfterValidator(_ordered_band), Field(strict=False)] = (
        Field(
            default=ISO_BAND_HZ,
            description="band of the velocity RMS (ISO 20816-3: 10 Hz to 1000 Hz); "
            "without it, a stream too slow for 1X has none",
        )
    )
    measures: Annotated[tuple[ListedMeasure, ...], Field(strict=False, max_length=100)] = Field(
        default=(),
        description="what else is measured, of every sensor that has it, with or without alarm",
        examples=['["kurtosis"]'],
    )
    keyphasor: Name | None = Field(
        default=None,
        description="the keyphasor of 1X and 2X; without one they are looked for near machine.speed_rpm",
        examples=["keyphasor"],
    )

    def band_hz(self, rate_hz: float, speed_rpm: float) -> tuple[float, float] | None:
        """The band of the velocity RMS of a stream; None: it has none, as no band would show the machine.

        Args:
            rate_hz: sampling rate of the stream.
            speed_rpm: of the machine.
        """
        low_hz, high_hz = self.velocity_band_hz
        stated = "velocity_band_hz" in self.model_fields_set
        if stated or high_hz < rate_hz / 2 or shows_1x(rate_hz, speed_rpm, low_hz):
            return self.velocity_band_hz
        return None
