"""A bearing in its housing, and the accelerometers that it is judged by."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Mapping

    from daqsvc.bearing.geometry import BearingOrders
    from daqsvc.detectors.bearing.direction import TwoSensors


@dataclass(frozen=True, slots=True)
class HousedBearing:
    """A bearing with the accelerometer on its housing.

    Attributes:
        name: of the bearing.
        sensor: name of the accelerometer.
        column: its column in the stream.
        orders: fault orders.
        two: the accelerometer on the rotor and the bearing's masses, if its races also differ by direction.
        units: of the accelerometers that it is judged by, by their names; empty if not known.
    """

    name: str
    sensor: str
    column: int
    orders: BearingOrders
    two: TwoSensors | None = None
    units: Mapping[str, str] = field(default_factory=dict)

    @property
    def sensors(self) -> tuple[str, ...]:
        """The accelerometers that it is judged by."""
        return (self.sensor,) if self.two is None else (self.two.rotor, self.sensor)

    @property
    def columns(self) -> tuple[int, ...]:
        """Their columns."""
        return (self.column,) if self.two is None else (self.two.column, self.column)
