"""The kinematics of a bearing, and its catalogue."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from daqsvc.bearing.geometry import (
    BearingGeometry,
    BearingOrders,
    bearing_orders,
    catalogue,
    catalogue_source,
)


def test_the_drive_end_bearing_of_the_cwru_rig() -> None:
    orders = bearing_orders("6205-2RS")
    assert orders.inner == pytest.approx(5.4152, abs=1.5e-3)
    assert orders.outer == pytest.approx(3.5848, abs=1.5e-3)
    assert orders.ball == pytest.approx(2.3567, abs=1.5e-3)
    assert orders.cage == pytest.approx(0.39828, abs=2e-4)


@pytest.mark.parametrize(
    ("name", "inner", "outer", "ball", "cage"),
    [
        ("6203-2RS", 4.9469, 3.0530, 1.9940, 0.3817),
        ("NICE", 4.755, 3.245, 2.5595, 0.4056),
        ("ER16K", 5.43, 3.572, 2.322, 0.397),
    ],
)
def test_published_orders(name: str, inner: float, outer: float, ball: float, cage: float) -> None:
    orders = bearing_orders(name)
    assert orders.inner == pytest.approx(inner, rel=1e-3)
    assert orders.outer == pytest.approx(outer, rel=1e-3)
    assert orders.ball == pytest.approx(ball, rel=2e-3)
    assert orders.cage == pytest.approx(cage, rel=2e-3)


@pytest.mark.parametrize(
    "name",
    [
        "6205",
        "6205-2RS",
        "6205-ZZ",
        "6205 2rs",
        "6205-2z",
        "6205/C3",
        "6205-2RS C3",
        "6205-2RSH/C3",
        "6205-C4",
        "6205Z",
        "6205RS",
        "6205-RS1",
        "6205N",
        "6205ZNR",
        "6205-2Z-N",
        "6205M/C3",
        "6205 TN9",
        "62052RS",
        "62052Z",
    ],
)
def test_seals_cage_clearance_case_and_blanks_do_not_matter(name: str) -> None:
    assert bearing_orders(name) == catalogue()["6205"]


@pytest.mark.parametrize(
    "name", ["7205B", "7205 B", "7205-b", "7205-B-2RS", "7205 BECBP", "7205BEP/C3", "FAG 7205-B-XL-TVP"]
)
def test_hyphens_and_cages_of_a_design_do_not_matter(name: str) -> None:
    assert bearing_orders(name) == catalogue()["7205B"]
    assert bearing_orders("NU 206 ECP") == catalogue()["NU206E"]


@pytest.mark.parametrize("name", ["7205AC", "6205ETN9", "NU2206ECP"])
def test_other_designs_are_other_bearings(name: str) -> None:
    with pytest.raises(KeyError, match="not in the catalogue"):
        bearing_orders(name)


@pytest.mark.parametrize("seal", ["Z", "-Z", "2Z", "-2Z", "RS", "2RS", "-RS1", "RSH", "-2RS1", "RZ"])
@pytest.mark.parametrize("name", ["6202", "6205", "6302", "6012", "62/22"])
def test_a_seal_is_no_part_of_the_size(name: str, seal: str) -> None:
    assert bearing_orders(name + seal) == catalogue()[name]


@pytest.mark.parametrize("name", ["6025", "6250", "6052", "620S", "62O5", "6205-XX", "6205-XX/C3"])
def test_a_slip_in_a_designation_is_answered_with_what_was_meant(name: str) -> None:
    with pytest.raises(
        KeyError, match=r"is not in the catalogue; did you mean 6205\?( Other near names: .*\.)? Give "
    ):
        bearing_orders(name)


def test_an_unknown_bearing_is_named_with_near_ones() -> None:
    with pytest.raises(KeyError, match=r"'6229-2RS'.*near names: 62.*BPFI="):
        bearing_orders("6229-2RS")
    with pytest.raises(KeyError, match=r"near names: 7205B, 7205A"):
        bearing_orders("7205")


@pytest.mark.parametrize(
    ("name", "kind"),
    [
        ("22210", "spherical roller"),
        ("22318 EK/C3", "spherical roller"),
        ("SKF 23120", "spherical roller"),
        ("24024", "spherical roller"),
        ("21310", "spherical roller"),
        ("30206", "tapered roller"),
        ("32008", "tapered roller"),
        ("33110", "tapered roller"),
        ("31308", "tapered roller"),
        ("NU2206ECP", "cylindrical roller"),
        ("NJ 310", "cylindrical roller"),
        ("N 206", "cylindrical roller"),
        ("HK1612", "needle roller"),
        ("2205", "self-aligning ball"),
    ],
)
def test_a_bearing_of_another_kind_is_named_and_no_near_name_is_of_balls(name: str, kind: str) -> None:
    with pytest.raises(KeyError) as refused:
        bearing_orders(name)
    said = refused.value.args[0]
    assert f", a {kind} bearing, is not in the catalogue; " in said
    near = said.partition("near names: ")[2].partition(".")[0]
    assert not {other for other in near.split(", ") if other} - {"NU205E", "NU206E", "2303", "1205"}


def test_the_catalogue_has_200_bearings_each_with_its_source() -> None:
    assert len(catalogue()) >= 200
    for name, orders in catalogue().items():
        assert len(catalogue_source(name)) > 20, name
        count = orders.inner + orders.outer
        assert count == pytest.approx(round(count), abs=0.01), name
        assert orders.outer == pytest.approx(count * orders.cage, rel=5e-3), name
    assert catalogue_source("6205-2RS").startswith("SKF 6205-2RS JEM")
    assert catalogue_source("6309").startswith("derived: ")
    with pytest.raises(KeyError, match="22220"):
        catalogue_source("22220")


@pytest.mark.parametrize(
    ("name", "outer"),
    [
        ("6202", 3.125),
        ("6208", 3.547),
        ("6210", 4.093),
        ("6211", 4.078),
        ("6212", 4.066),
        ("6213", 4.099),
        ("6214", 4.104),
        ("6303", 2.545),
        ("6307", 3.006),
        ("6308", 3.023),
        ("6309", 3.037),
        ("6310", 3.047),
        ("6311", 3.057),
        ("6312", 3.064),
        ("6314", 3.076),
        ("6315", 3.081),
        ("6316", 3.086),
        ("6318", 3.093),
    ],
)
def test_what_is_derived_from_ratings_is_near_what_another_maker_publishes(name: str, outer: float) -> None:
    # Timken, coefficients of basic outer-ring sizes 202K to 318K: other balls, but as many.
    assert catalogue_source(name).startswith("derived")
    assert bearing_orders(name).outer == pytest.approx(outer, rel=0.023)


def test_bearings_of_the_same_orders_are_not_all_named() -> None:
    assert str(bearing_orders("6209")).count(" or ") <= 3


geometries = st.builds(
    lambda balls, share, angle: BearingGeometry(balls, share * 60.0, 60.0, angle),
    st.integers(6, 20),
    st.floats(0.05, 0.14),
    st.floats(0.0, 40.0),
)


@given(geometries)
def test_every_ball_passes_either_race(geometry: BearingGeometry) -> None:
    orders = geometry.orders()
    assert orders.inner + orders.outer == pytest.approx(geometry.balls)
    assert orders.outer == pytest.approx(geometry.balls * orders.cage)
    assert orders.ball_pass == 2.0 * orders.ball


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((2, 8.0, 40.0), "2 rolling elements"),
        ((9, 0.0, 40.0), "ball diameter"),
        ((9, 41.0, 40.0), "ball diameter"),
        ((9, 8.0, 40.0, 90.0), "contact angle"),
        ((20, 8.0, 40.0), "do not fit"),
    ],
)
def test_impossible_dimensions_are_refused(arguments: tuple[float, ...], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        BearingGeometry(*arguments)


@pytest.mark.parametrize(
    ("orders", "message"),
    [
        ((0.0, 3.58, 2.36, 0.398), "inner"),
        ((5.4, float("nan"), 2.36, 0.398), "outer"),
        ((162.0, 107.0, 70.0, 11.9), "not in Hz"),
        ((3.58, 5.42, 2.36, 0.398), "exchanged"),
        ((5.42, 3.58, 2.36, 0.30), "does not fit"),
    ],
)
def test_contradicting_orders_are_refused(orders: tuple[float, ...], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        BearingOrders(*orders)
