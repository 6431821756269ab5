"""The evaluation zones of ISO 20816-3 as ready-made limits: by class of machine, or by its speed.

Zone A is a new machine, B one that may run for long, C one that may run until it can be repaired, D one
that takes damage. Limits of the maker, or of experience with the machine, are better where there are any.

The velocities were found alike in two public programs, the law of the shaft is common knowledge; neither was
compared with the text of the standard, which is for sale.
"""

from __future__ import annotations

import math
from typing import Annotated, Literal

from pydantic import Field

from daqsvc.settings.section import Section

Boundaries = tuple[float, float, float]

_VELOCITY_MM_S: dict[tuple[int, str], Boundaries] = {
    (1, "rigid"): (2.3, 4.5, 7.1),
    (1, "flexible"): (3.5, 7.1, 11.0),
    (2, "rigid"): (1.4, 2.8, 4.5),
    (2, "flexible"): (2.3, 4.5, 7.1),
}
"""RMS of the velocity at A/B, B/C and C/D, by group and support."""
_SHAFT_UM: Boundaries = (4800.0, 9000.0, 13_200.0)
"""Peak to peak of the shaft at these, times the root of its speed in revolutions a minute."""
_UM_PER_UNIT = {"um": 1.0, "mm": 1000.0, "mil": 25.4}


class Zones(Section):
    """Zones of a standard: by default zone C is alert and zone D is danger."""

    standard: Annotated[
        Literal["iso-20816-3"],
        Field(description="the standard whose zones they are", examples=["iso-20816-3"]),
    ]
    group: Literal[1, 2] | None = Field(
        default=None,
        description="group of the machine, for velocities: 1 above 300 kW or a shaft height of 315 mm, "
        "2 from 15 kW or 160 mm on",
        examples=[2],
    )
    support: Literal["rigid", "flexible"] | None = Field(
        default=None, description="how the machine is supported, for velocities", examples=["rigid"]
    )
    shaft: bool = Field(
        default=False,
        description="whether the zones are those of shaft vibration, peak to peak, by machine.speed_rpm",
    )


def boundaries(zones: Zones, speed_rpm: float, unit: str) -> Boundaries | None:
    """A/B, B/C and C/D in the unit of a measure; None if the table does not state enough.

    Args:
        zones: the table.
        speed_rpm: stated speed of the machine.
        unit: of the measure.
    """
    if zones.shaft:
        um = _UM_PER_UNIT.get(unit)
        if um is None:
            return None
        # Four digits are more than the standard has, and what a person can read.
        ab, bc, cd = (float(f"{k / math.sqrt(abs(speed_rpm)) / um:.4g}") for k in _SHAFT_UM)
        return ab, bc, cd
    if zones.group is None or zones.support is None or unit != "mm/s":
        return None
    return _VELOCITY_MM_S[zones.group, zones.support]
