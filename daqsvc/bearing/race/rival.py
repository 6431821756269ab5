"""Lines of one part at the stated speed are those of another part at another speed: which speed is true?"""

from __future__ import annotations

from typing import TYPE_CHECKING

from daqsvc.bearing.race.combs import fundamental
from daqsvc.bearing.race.verdict import PARTS, PLACES
from daqsvc.dsp.quality import UnfitError
from daqsvc.dsp.speed.harmonics import REMEDY

if TYPE_CHECKING:
    from collections.abc import Mapping

    from daqsvc.bearing.geometry import BearingOrders
    from daqsvc.bearing.race.verdict import Part, PartEvidence
    from daqsvc.dsp.speed.harmonics import ShaftRate


def refuse_rivals(
    evidence: Mapping[Part, PartEvidence], bearing: BearingOrders, shaft: ShaftRate, slip: float
) -> None:
    """Refuse to name a part that only a doubtful speed makes of these lines.

    Harmonics may be too few to confirm the stated speed, and yet more of them may speak for the speed at
    which the same lines are those of another part.

    Args:
        evidence: of each part.
        bearing: its fault orders.
        shaft: rate of the shaft.
        slip: how far the lines of a part may be from their place, as a share.

    Raises:
        UnfitError: they do.
    """
    if shaft.seen:
        return
    for part in PARTS:
        e = evidence[part]
        if e.z < e.z_limit or e.severity < e.limit:
            continue
        for other in PARTS:
            rival_hz = shaft.rate_hz * e.order / fundamental(bearing, other)
            if other != part and shaft.outvoted(rival_hz, slip):
                here, there = 60.0 * shaft.rate_hz, 60.0 * rival_hz
                raise UnfitError(
                    "shaft speed or sample rate",
                    f"is in doubt: the lines of the {PLACES[part]} at {here:.0f} rpm are those of the "
                    f"{PLACES[other]} at {there:.0f} rpm, where more harmonics of a shaft stand out",
                    REMEDY,
                )
