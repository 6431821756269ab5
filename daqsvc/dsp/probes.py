"""Proximity probes, and the plane that two of them look at together."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Probe:
    """A proximity probe.

    Attributes:
        name: name of the sensor.
        column: its column in the stream, counted from the shaft-centred position.
        angle_deg: where it points, from +x anticlockwise.
        um_per_unit: micrometres in a unit of the column.
    """

    name: str
    column: int
    angle_deg: float
    um_per_unit: float = 1.0


def shaft_axes_deg(angles_deg: tuple[float, float], *, clockwise: bool) -> tuple[float, float]:
    """Where probes point in the coordinates of the shaft, in which it turns from x to y.

    A shaft that turns clockwise is viewed from its other end: x is mirrored, gravity still points down.

    Args:
        angles_deg: where they point on the machine, from +x anticlockwise.
        clockwise: whether the shaft turns clockwise there.
    """
    x, y = angles_deg
    return (180.0 - x, 180.0 - y) if clockwise else (x, y)


def probes_to_xy(angles_deg: tuple[float, float]) -> Floats:
    """Matrix from positions along two probes to x and y.

    Args:
        angles_deg: where they point; not in one line.

    Returns:
        float64 ``[2, 2]``, to be multiplied from the right to positions ``[n, 2]``.
    """
    angles = np.radians(angles_deg)
    matrix: Floats = np.linalg.inv(np.vstack((np.cos(angles), np.sin(angles))))
    return matrix
