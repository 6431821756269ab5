"""The fault orders of a bearing of a machine file, in whichever way it states them."""

from __future__ import annotations

from typing import TYPE_CHECKING

from daqsvc.bearing.geometry import BearingGeometry, BearingOrders, bearing_orders

if TYPE_CHECKING:
    from daqsvc.detectors.bearing.settings import RollingGeometry, WatchedBearing


def orders_by(geometry: RollingGeometry) -> BearingOrders:
    """Fault orders by dimensions, in pure rolling.

    Raises:
        ValueError: no bearing has these dimensions.
    """
    return BearingGeometry(
        geometry.balls, geometry.ball_diameter_mm, geometry.pitch_diameter_mm, geometry.contact_deg
    ).orders()


def orders_of(settings: WatchedBearing, index: int) -> BearingOrders:
    """Fault orders of a bearing of a machine file.

    Args:
        settings: the bearing.
        index: its place in ``pipeline.bearing.bearings``.

    Raises:
        ValueError: the catalogue does not know it, or its orders or dimensions contradict each other.
    """
    at = f"pipeline.bearing.bearings[{index}]"
    orders, geometry = settings.orders, settings.geometry
    if orders is not None:
        try:
            return BearingOrders(inner=orders.bpfi, outer=orders.bpfo, ball=orders.bsf, cage=orders.ftf)
        except ValueError as error:
            raise ValueError(f"{at}.orders: {error}") from None
    if geometry is not None:
        try:
            return orders_by(geometry)
        except ValueError as error:
            raise ValueError(f"{at}.geometry: {error}") from None
    assert settings.type is not None  # noqa: S101 - detectors/bearing/checks.py: one of the three
    try:
        return bearing_orders(settings.type)
    except KeyError as error:
        raise ValueError(f"{at}.type: {error.args[0]}") from None
