"""Kinematics of a rolling bearing: how often its parts meet, per revolution of the shaft.

Pure rolling, inner ring turning, outer ring standing still. Real bearings slip by 1 to 2 %: the cage falls
behind, and with it the rate at which balls pass the outer race, while they pass the inner race more often.
A catalogue, `bearings.toml`, has the figures by a bearing's designation, with the source of each.
"""

from __future__ import annotations

import difflib
import math
import re
import tomllib
from dataclasses import astuple, dataclass
from functools import cache
from importlib.resources import files
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence


SUM_TOLERANCE = 0.05
"""Relative departure of stated orders from the kinematic laws at which they are refused."""

ROUNDED = 2e-3
"""Orders that differ by no larger a share are the same; races slip by ten times as much."""


_NAMED = 3
"""Largest number of bearings with the same orders that are named."""


@dataclass(frozen=True, slots=True)
class BearingOrders:
    """Fault orders of a bearing: events per revolution of the shaft.

    Attributes:
        inner: BPFI, balls passing a point of the inner race.
        outer: BPFO, balls passing a point of the outer race.
        ball: BSF, revolutions of a ball about itself. A spot on a ball strikes twice in each, once
            on either race: `ball_pass`.
        cage: FTF, revolutions of the cage.

    Raises:
        ValueError: the four contradict each other, or are not those of a bearing with its outer ring at rest.
    """

    inner: float
    outer: float
    ball: float
    cage: float

    def __post_init__(self) -> None:
        for name in ("inner", "outer", "ball", "cage"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0.0):
                raise ValueError(
                    f"bearing order {name} is {value}; it must be a positive number per revolution"
                )
        if not self.cage < 0.5:
            raise ValueError(
                f"cage order (FTF) is {self.cage:g}; with the outer ring at rest it lies below 0.5: "
                "give all orders per revolution of the shaft, not in Hz"
            )
        if not self.outer < self.inner:
            raise ValueError(
                f"outer order (BPFO) {self.outer:g} is not below the inner order (BPFI) {self.inner:g}; "
                "they are exchanged, or the outer ring turns"
            )
        expected = self.outer / self.cage * (1.0 - self.cage)
        if abs(self.inner / expected - 1.0) > SUM_TOLERANCE:
            raise ValueError(
                f"BPFI {self.inner:g} does not fit BPFO {self.outer:g} and FTF {self.cage:g}, which make it "
                f"{expected:.4g}; check the four orders"
            )

    @property
    def ball_pass(self) -> float:
        """2 BSF: strikes of a spot on a ball per revolution of the shaft."""
        return 2.0 * self.ball

    def __str__(self) -> str:
        """Its designations in the catalogue, e.g. ``"6205"``, or else the four orders."""
        names = [name for name, known in catalogue().items() if self.same_as(known)]
        orders = f"BPFI {self.inner:.5g}, BPFO {self.outer:.5g}, BSF {self.ball:.5g}, FTF {self.cage:.4g}"
        more = [f"{len(names) - _NAMED} others"] if len(names) > _NAMED else []
        return " or ".join([*names[:_NAMED], *more]) or orders

    def same_as(self, other: BearingOrders) -> bool:
        """Whether all four are those of ``other``, but for how they were rounded."""
        return all(
            math.isclose(mine, its, rel_tol=ROUNDED)
            for mine, its in zip(astuple(self), astuple(other), strict=True)
        )


@dataclass(frozen=True, slots=True)
class BearingGeometry:
    """The dimensions that decide a bearing's fault orders.

    Attributes:
        balls: number of rolling elements (of one row).
        ball_diameter: in any unit, the same as ``pitch_diameter``.
        pitch_diameter: diameter of the circle through the centres of the balls.
        contact_angle_deg: 0 for a deep-groove bearing under radial load.

    Raises:
        ValueError: no bearing can have these dimensions.
    """

    balls: int
    ball_diameter: float
    pitch_diameter: float
    contact_angle_deg: float = 0.0

    def __post_init__(self) -> None:
        if self.balls < 3:
            raise ValueError(f"a bearing with {self.balls} rolling elements does not run; give 3 or more")
        if not 0.0 < self.ball_diameter < self.pitch_diameter:
            raise ValueError(
                f"ball diameter {self.ball_diameter:g} must be positive and below the pitch diameter "
                f"{self.pitch_diameter:g}"
            )
        if not 0.0 <= self.contact_angle_deg < 90.0:
            raise ValueError(
                f"contact angle is {self.contact_angle_deg:g} deg; it must be from 0 to below 90"
            )
        room = self.pitch_diameter * math.sin(math.pi / self.balls)
        if self.ball_diameter >= room:
            raise ValueError(
                f"{self.balls} balls of diameter {self.ball_diameter:g} do not fit on a pitch circle of "
                f"{self.pitch_diameter:g}; the largest that do have {room:.4g}"
            )

    def orders(self) -> BearingOrders:
        """The fault orders in pure rolling (Randall and Antoni 2011, eq. 1 to 4)."""
        gamma = self.ball_diameter / self.pitch_diameter * math.cos(math.radians(self.contact_angle_deg))
        return BearingOrders(
            inner=0.5 * self.balls * (1.0 + gamma),
            outer=0.5 * self.balls * (1.0 - gamma),
            ball=0.5 * self.pitch_diameter / self.ball_diameter * (1.0 - gamma**2),
            cage=0.5 * (1.0 - gamma),
        )


SUFFIX = re.compile(
    r"(-2?)?((RS[HLR]?|R?Z)\d?|ZZ|VV|DDU|LLU|LLB"  # seals and shields
    r"|NR?|MA?|J|TN9?|TVH|TVP2?)$"  # snap ring and its groove, cage
)
"""Suffixes that change neither number nor size of the balls, in the letters of several makers."""


MAKER = re.compile(r"^(SKF|FAG|INA|NSK|NTN|KOYO|TIMKEN|SNR|NACHI)(?=[A-Z0-9])")
DESIGN = re.compile(r"(7[23]\d\dB|NU\d+E)[A-Z0-9]*$")
"""Designs whose further letters are of the cage, or of pairs: 7205 BECBP, NU 206 ECP."""
CLEARANCE = re.compile(r"/?C[2-5]$")
"""Suffix of the clearance inside, which does not move the orders."""
MISREAD = str.maketrans("OISZ", "0152")
"""Letters that are read, or typed, for figures."""


KINDS: Mapping[str, re.Pattern[str]] = {
    "spherical roller": re.compile(r"2(13|2[23]|3[01289]|4[0189])\d\d"),
    "tapered roller": re.compile(r"3(0[23]|1[13]|2[0239]|3[012])\d\d"),
    "cylindrical roller": re.compile(r"(NU|NJ|NUP|NCF|NNU|NN|NF|N)\d{3}"),
    "needle roller": re.compile(r"(NA|RNA|NK|NKI|NKS|HK|BK)\d\d"),
    "self-aligning ball": re.compile(r"(1[23]|2[23])\d\d(?!\d)"),
}
"""How designations begin whose series states a kind of bearing, as makers use them."""


def _kind(name: str) -> str:
    """The kind of bearing that a designation states; empty of all others."""
    return next((kind for kind, begins in KINDS.items() if begins.match(name)), "")


@cache
def _entries() -> Mapping[str, Mapping[str, Any]]:
    text = files("daqsvc.bearing").joinpath("bearings.toml").read_text(encoding="utf-8")
    return tomllib.loads(text)


@cache
def catalogue() -> Mapping[str, BearingOrders]:
    """Fault orders of all known bearings, by designation."""
    return {name: _orders(entry) for name, entry in _entries()["bearings"].items()}


def catalogue_source(designation: str) -> str:
    """Where the entry of a bearing comes from, in a sentence.

    Args:
        designation: as `bearing_orders` takes it.

    Raises:
        KeyError: it is not in the catalogue.
    """
    entries = _entries()
    source: str = entries["sources"][entries["bearings"][_known_as(designation)]["source"]]
    return source


def bearing_orders(designation: str) -> BearingOrders:
    """Fault orders of a bearing in the catalogue.

    Args:
        designation: e.g. ``"6205-2RS"``; case, blanks, seals, cage and clearance do not matter.

    Raises:
        KeyError: it is not in the catalogue; the message lists near names.
    """
    return catalogue()[_known_as(designation)]


def _known_as(designation: str) -> str:
    """The name of a bearing in the catalogue."""
    known = catalogue()
    wanted = MAKER.sub("", designation.upper().replace(" ", ""))
    if wanted not in known and "/" in wanted[4:]:
        # Behind a stroke: clearance, grease, tests; but 62/22 is a size.
        wanted = wanted[:4] + wanted[4:].partition("/")[0]
    bare = CLEARANCE.sub("", wanted).rstrip("-")
    while bare not in known and (shorter := SUFFIX.sub("", bare)) != bare:
        # 62052RS has two seals, and 6202RS has one.
        bare = shorter[:-1] if shorter.endswith("2") and shorter[:-1] in known else shorter
    joined = bare.replace("-", "")
    for name in (wanted, bare, joined, DESIGN.sub(r"\1", joined)):
        if name in known:
            return name
    # Orders of another kind are no help, however near its name is.
    kind = _kind(bare)
    of_kind = f", a {kind} bearing," if kind else ""
    meant, near = _near(bare, [name for name in known if _kind(name) == kind])
    names = [f"did you mean {' or '.join(meant)}?"] if meant else []
    if near:
        names.append(f"{'Other near' if meant else 'near'} names: {', '.join(near)}.")
    raise KeyError(
        f"bearing {designation!r}{of_kind} is not in the catalogue; "
        f"{' '.join(names) or 'no name in it is near.'} "
        "Give its dimensions or its orders instead: BPFI=..,BPFO=..,BSF=..,FTF=.."
    )


def _near(wanted: str, known: Sequence[str]) -> tuple[list[str], list[str]]:
    """Names that are written alike, and others that are near.

    Figures exchanged, a letter for a figure, and letters behind a known name are slips of whoever writes it.
    """
    figures = wanted.translate(MISREAD)
    stem = wanted.partition("-")[0]
    alike = [
        name
        for name in known
        if name in {figures, stem} or (name[0] == wanted[:1] and sorted(name) == sorted(wanted))
    ]
    near = difflib.get_close_matches(wanted, [name for name in known if name not in alike], n=4, cutoff=0.6)
    return alike, near


def _orders(entry: Mapping[str, Any]) -> BearingOrders:
    if "bpfi" in entry:
        return BearingOrders(entry["bpfi"], entry["bpfo"], entry["bsf"], entry["ftf"])
    return BearingGeometry(
        balls=int(entry["balls"]),
        ball_diameter=entry["ball_diameter_mm"],
        pitch_diameter=entry["pitch_diameter_mm"],
        contact_angle_deg=entry.get("contact_angle_deg", 0.0),
    ).orders()
