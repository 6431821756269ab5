"""Machines that nobody chose: one of each kind, its dimensions drawn by lot from the ranges below.

    python -m plants.drawn      prints them

The seed, the ranges and what a draw is rejected for were committed before anything was evaluated. A draw is
rejected only if it is no machine that could be run: see `_physical`. The first draw that is not rejected is
taken, whatever the detectors say of it. Once detectors are changed with a draw in view, another seed is used.
"""

from __future__ import annotations

import math
import sys
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from plants.bench import Bench
from plants.machines import Geometry, Journal, Model, Support, stable

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

_SEED = 23
"""Of the draw that counts. 17 was evaluated on 2026-11-29; a margin of names was chosen with it in view. 18
was first evaluated on 2026-11-30; false alarms were corrected and the bank was changed with it in view. 19
was evaluated on the same day; nothing was changed with it in view, but detectors were changed after it. 20
was evaluated on the same day; with it in view, records were made longer, and how 1X follows its speed was
changed. 21 was evaluated after that; with it in view, the threshold of a departure was raised. 22 with
that; with it in view, the supports' part in the deflection was left open. 23 was evaluated again on the same
day, after changes of the detectors that other machines called for."""
_MOST_DRAWS = 200

_ELEMENTS = 10
_SLENDER = (16.0, 25.0)
"""Length of a shaft over its diameter."""
_LENGTH_M, _LONG_M = (0.5, 1.0), (1.1, 1.7)
"""Of a shaft on springs, and on oil films."""
_DISC_WIDTH_M, _DISC_OF_SHAFT = (0.03, 0.06), (4.0, 7.0)
"""Width of a disc, and its diameter over that of the shaft."""
_ECCENTRIC_UM = (8.0, 25.0)
_SPRING_N_M, _OTHER_SPRING = (3e6, 1.5e7), (0.5, 1.5)
"""Of the first support, by the logarithm, and of the second over the first."""
_DAMPER_S = (1e-3, 3e-3)
"""Damping of a support over its stiffness."""
_UNEVEN = (1.3, 2.0)
"""Stiffness in y over that in x, where supports or pedestals are uneven."""
_FILM_LENGTH, _FILM_CLEARANCE, _OIL_PA_S = (0.45, 0.6), (1.3e-3, 1.7e-3), (0.02, 0.04)
"""Length of a plain bearing and its radial clearance over its diameter, and the viscosity of its oil."""
_PEDESTAL_N_M, _PEDESTAL_KG, _PEDESTAL_S = (3e7, 1e8), (10.0, 30.0), (5e-5, 1e-4)
"""Stiffness in x, by the logarithm, moving mass, and damping over stiffness."""
_BELOW, _AT, _ABOVE = (0.55, 0.85), (0.95, 1.05), (1.2, 1.5)
"""Speeds over the first critical one; a run-up goes to 1.55 of it."""

_CRITICAL_HZ = (15.0, 100.0)
"""First critical speeds that a shaft of these lengths is run beyond."""
_DAMPING_RATIO = (0.02, 0.15)
"""Below it no protection lets a machine run at its critical speed, above it a Bode plot shows no peak."""
_LEAST_WHIRL_M = 2e-6
"""Proximity probes see no less."""
_FILM_WHIRL, _FILM_ECCENTRIC = 0.2, 0.8
"""Of a film's clearance: beyond them the film is not linear."""


@dataclass(frozen=True, slots=True)
class Drawn:
    """A machine, and what it took.

    Attributes:
        geometry: of it.
        draws: the last one was taken.
        critical_hz: first critical speed.
        damping_ratio: by the width of its peak.
    """

    geometry: Geometry
    draws: int
    critical_hz: float
    damping_ratio: float


class _Lot:
    """Draws from ranges."""

    def __init__(self, kind: int) -> None:
        self._rng = np.random.default_rng([_SEED, kind])

    def of(self, limits: tuple[float, float]) -> float:
        """A number between two, each as likely, to four digits."""
        return float(f"{self._rng.uniform(*limits):.4g}")

    def log(self, limits: tuple[float, float]) -> float:
        """The same, each ratio as likely."""
        return float(f"{math.exp(self._rng.uniform(*map(math.log, limits))):.4g}")

    def one(self, *choices: int) -> int:
        """One of several."""
        return int(self._rng.choice(choices))

    def some(self, count: int, *choices: int) -> list[int]:
        """So many of several, in their order."""
        return sorted(int(n) for n in self._rng.choice(choices, count, replace=False))


def _springs(
    lot: _Lot, nodes: tuple[int, int], uneven: tuple[float, float] = (1.0, 1.0)
) -> tuple[Support, ...]:
    first, ratio = lot.log(_SPRING_N_M), lot.of(uneven)
    made = []
    for node, x in zip(nodes, (first, first * lot.of(_OTHER_SPRING)), strict=True):
        damper = x * lot.of(_DAMPER_S)
        made.append(
            Support(
                node=node, stiffness_n_m=(x, x * ratio), damping_n_s_m=(damper, damper * math.sqrt(ratio))
            )
        )
    return tuple(made)


def _films(lot: _Lot, diameter_m: float) -> tuple[Support, ...]:
    journal = Journal(
        length_m=diameter_m * lot.of(_FILM_LENGTH),
        diameter_m=diameter_m,
        clearance_m=diameter_m * lot.of(_FILM_CLEARANCE),
        viscosity_pa_s=lot.of(_OIL_PA_S),
    )
    x, ratio = lot.log(_PEDESTAL_N_M), lot.of(_UNEVEN)
    damper, mass = x * lot.of(_PEDESTAL_S), lot.of(_PEDESTAL_KG)
    return tuple(
        Support(
            node=node,
            journal=journal,
            pedestal_stiffness_n_m=(x, x * ratio),
            pedestal_mass_kg=mass,
            pedestal_damping_n_s_m=(damper, damper * math.sqrt(ratio)),
        )
        for node in (0, _ELEMENTS)
    )


def _made(
    lot: _Lot,
    kind: str,
    discs: list[int],
    supports: Callable[[float], tuple[Support, ...]],
    length_m: tuple[float, float] = _LENGTH_M,
    probes: tuple[int, ...] = (-1, 0, 1),
) -> Geometry:
    """A shaft with discs at some nodes; probes are near one of them, the least clearance is at one."""
    length = lot.of(length_m)
    diameter = float(f"{length / lot.of(_SLENDER):.3g}")
    overhung = discs[-1] == _ELEMENTS
    return Geometry(
        name=f"drawn {kind}",
        part="drawn",
        shaft=((length / _ELEMENTS, diameter),) * _ELEMENTS,
        discs=tuple((n, lot.of(_DISC_WIDTH_M), diameter * lot.of(_DISC_OF_SHAFT)) for n in discs),
        supports=supports(diameter),
        probes=lot.one(*discs) + lot.one(*probes),
        rub=lot.one(*discs),
        coupling=0 if overhung else lot.one(0, _ELEMENTS),
        cracked=lot.one(7, 8) if overhung else lot.one(3, 4, 5, 6),
        unbalance_um=tuple((lot.of(_ECCENTRIC_UM), lot.of((0.0, 2.0 * math.pi))) for _ in discs),
        of_speeds=tuple(round(lot.of(part), 2) for part in (_BELOW, _AT, _ABOVE)),
    )


def _between_bearings(lot: _Lot) -> Geometry:
    return _made(lot, "between bearings", [lot.one(3, 4, 5, 6, 7)], lambda _: _springs(lot, (0, _ELEMENTS)))


def _overhung(lot: _Lot) -> Geometry:
    nodes = lot.one(0, 1), lot.one(6, 7)
    return _made(lot, "overhung", [_ELEMENTS], lambda _: _springs(lot, nodes), probes=(-2, -1))


def _two_discs(lot: _Lot) -> Geometry:
    discs = [lot.one(2, 3, 4), lot.one(6, 7, 8)]
    return _made(lot, "two discs", discs, lambda _: _springs(lot, (0, _ELEMENTS)))


def _journals_on_pedestals(lot: _Lot) -> Geometry:
    discs = lot.some(lot.one(2, 3), 3, 4, 5, 6, 7)
    return _made(lot, "journals on pedestals", discs, lambda diameter: _films(lot, diameter), _LONG_M)


def _anisotropic_supports(lot: _Lot) -> Geometry:
    discs = [lot.one(3, 4, 5, 6, 7)]
    return _made(lot, "anisotropic supports", discs, lambda _: _springs(lot, (0, _ELEMENTS), _UNEVEN))


_KINDS: tuple[Callable[[_Lot], Geometry], ...] = (
    _between_bearings,
    _overhung,
    _two_discs,
    _journals_on_pedestals,
    _anisotropic_supports,
)


def _runs(bench: Bench) -> bool:
    """Whether a machine can be run at a speed, and its whirl seen."""
    if not stable(bench.healthy) or bench.whirl_m < _LEAST_WHIRL_M:
        return False
    q = bench.response(bench.unbalance)
    for i, support in enumerate(bench.geometry.supports):
        if support.journal is None:
            continue
        rows = [bench.healthy.places[f"support {i} {axis}"] for axis in "xy"]
        whirl = math.hypot(*(abs(row @ q) for row in rows)) / support.journal.clearance_m
        rest = math.hypot(*(row @ bench.healthy.rest for row in rows)) / support.journal.clearance_m
        if whirl > _FILM_WHIRL or rest > _FILM_ECCENTRIC:
            return False
    return True


def _physical(model: Model, critical_rad_s: float, damping_ratio: float) -> bool:
    """Whether a draw is a machine that could be run at its three speeds."""
    low, high = _CRITICAL_HZ
    if not low <= critical_rad_s / (2.0 * math.pi) <= high:
        return False
    if not _DAMPING_RATIO[0] <= damping_ratio <= _DAMPING_RATIO[1]:
        return False
    critical = critical_rad_s, damping_ratio
    return all(_runs(Bench(model, of_critical, critical)) for of_critical in model.geometry.of_speeds)


def _draw() -> Iterator[Drawn]:
    for kind, make in enumerate(_KINDS):
        lot = _Lot(kind)
        for draws in range(1, _MOST_DRAWS + 1):
            model = Model(make(lot))
            critical, damping_ratio = model.first_critical()
            if _physical(model, critical, damping_ratio):
                yield Drawn(model.geometry, draws, critical / (2.0 * math.pi), damping_ratio)
                break
        else:
            raise ValueError(f"no machine of kind {kind} in {_MOST_DRAWS} draws")


def drawn() -> tuple[Geometry, ...]:
    """The machines, one of each kind."""
    return tuple(one.geometry for one in _draw())


def main() -> int:
    """Print them."""
    for one in _draw():
        print(f"draw {one.draws}: {one.critical_hz:.1f} Hz, damping ratio {one.damping_ratio:.3f}")  # noqa: T201
        print(one.geometry)  # noqa: T201
    return 0


if __name__ == "__main__":
    sys.exit(main())
