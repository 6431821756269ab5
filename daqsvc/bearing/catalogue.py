"""Fault orders by a bearing's designation: a small catalogue, `bearings.toml`."""

from __future__ import annotations

import difflib
import tomllib
from functools import cache
from importlib.resources import files
from typing import TYPE_CHECKING

from daqsvc.bearing.geometry import BearingGeometry, BearingOrders

if TYPE_CHECKING:
    from collections.abc import Mapping

SEALS = (
    "-2RS1",
    "-2RSH",
    "-2RSR",
    "-2RS",
    "-2RZ",
    "-2Z",
    "-RS",
    "-RZ",
    "-ZZ",
    "-Z",
    "2RS",
    "ZZ",
    "VV",
    "DDU",
)
"""Suffixes of seals and shields: they change nothing inside."""


@cache
def catalogue() -> Mapping[str, BearingOrders]:
    """Fault orders of all known bearings, by designation."""
    text = files("daqsvc.bearing").joinpath("bearings.toml").read_text(encoding="utf-8")
    return {name: _orders(entry) for name, entry in tomllib.loads(text).items()}


def bearing_orders(designation: str) -> BearingOrders:
    """Fault orders of a bearing in the catalogue.

    Args:
        designation: e.g. ``"6205-2RS"``; case, blanks and the seals' suffix do not matter.

    Raises:
        KeyError: it is not in the catalogue; the message lists near names.
    """
    known = catalogue()
    wanted = designation.upper().replace(" ", "")
    bare = next((wanted.removesuffix(seal) for seal in SEALS if wanted.endswith(seal)), wanted)
    for name in (wanted, bare):
        if name in known:
            return known[name]
    near = difflib.get_close_matches(bare, known, n=4, cutoff=0.5) or sorted(known)
    stem = bare.partition("-")[0]
    # Of a known bearing, only the seals were written in a way that nobody uses.
    meant = f" (did you mean {stem}-2RS?)" if stem in known else ""
    raise KeyError(
        f"bearing {designation!r} is not in the catalogue; near names: {', '.join(near)}{meant}. "
        "Give its orders instead: BPFI=..,BPFO=..,BSF=..,FTF=.."
    )


def _orders(entry: Mapping[str, float]) -> BearingOrders:
    return BearingGeometry(
        balls=int(entry["balls"]),
        ball_diameter=entry["ball_diameter_mm"],
        pitch_diameter=entry["pitch_diameter_mm"],
        contact_angle_deg=entry.get("contact_angle_deg", 0.0),
    ).orders()
