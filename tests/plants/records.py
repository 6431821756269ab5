"""All records of the plants: every geometry, below, at and above its first critical speed, with every fault.

    python -m plants.records FOLDER      writes one ``.npz`` a record, and ``cases.json``

What is recorded is what ideal probes see; noise is for who reads it. Runout, thermal drift of the probes and
hunting of the speed are in the records, the first in all of them.
"""

from __future__ import annotations

import json
import math
import sys
import zlib
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from plants.bench import Bench
from plants.drawn import drawn
from plants.machines import GEOMETRIES, GRAVITY_M_S2, Geometry, Machine, Model, stable
from plants.simulate import Contact, Crack, Loose, Motion, Stage, move
from plants.timing import ONSET_REV, PER_REV, REVOLUTIONS

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    Complexes = NDArray[np.complex128]

RUNOUT = 0.05
"""Of the healthy whirl, in harmonics 1 to 3."""
DRIFT_UM = 1.0
_STOPPED = 15.0
"""No machine goes on with an orbit so many times the healthy one."""
HUNTING = 0.01


@dataclass(frozen=True, slots=True)
class Case:
    """A record and what is true of it.

    Attributes:
        name: of the file.
        geometry: of the machine.
        part: of the bench that it belongs to.
        speed_rpm: mean shaft speed.
        of_critical: the same in parts of the first critical speed.
        fault: what happens.
        onset_rev: when.
        size: of the fault, in its own terms.
        critical_hz: first critical speed, as a Bode plot shows it.
        damping_ratio: by the width of its peak.
        clearance_um: radial, by the drawing.
        moved: change of the orbit's synchronous vector over the healthy whirl, settled, without noise.
        speed_hunts: whether the speed varies.
    """

    name: str
    geometry: str
    part: str
    speed_rpm: float
    of_critical: float
    fault: str
    onset_rev: float
    size: float
    critical_hz: float
    damping_ratio: float
    clearance_um: float
    moved: float
    speed_hunts: bool


Fault = tuple[float, list[Stage]]


def _unbalance(b: Bench, rng: np.random.Generator) -> Fault:
    size = rng.uniform(0.4, 1.5)
    i = int(rng.integers(len(b.geometry.discs)))
    total = float(np.abs(b.unbalance).max())
    row = b.healthy.places[f"disc {i} x"] - 1j * b.healthy.places[f"disc {i} y"]
    more = size * total / float(np.abs(row).max()) * np.exp(2j * np.pi * rng.random()) * row
    return size, [b.stage(ONSET_REV, turning=b.turning(more))]


def _bow(b: Bench, rng: np.random.Generator) -> Fault:
    size = rng.uniform(0.4, 1.2)
    # A shaft that is bent by heat turns with its bend, as with an unbalance that grows.
    row = b.healthy.places["rub x"] - 1j * b.healthy.places["rub y"]
    force = size * b.whirl_m / b.seen(row, 1) * np.exp(2j * np.pi * rng.random()) * row
    return size, [
        b.stage(ONSET_REV + 20.0 * part, turning=b.turning(part * force))
        for part in np.linspace(0.1, 1.0, 10)
    ]


def _damping_loss(b: Bench, rng: np.random.Generator) -> Fault:
    size = rng.uniform(0.35, 0.7)
    if b.geometry.supports[0].journal is not None:
        # No figure of an oil film is its damping alone: a part of all that is not gyroscopic goes.
        damping = b.healthy.damping
        lost = (1.0 - size) * (damping + damping.T) / 4.0
        return size, [b.stage(ONSET_REV, replace(b.healthy, damping=damping - lost))]
    return size, [b.stage(ONSET_REV, b.machine(damping=size))]


def _softer_support(b: Bench, rng: np.random.Generator) -> Fault:
    size, which = rng.uniform(0.3, 0.6), int(rng.integers(2))
    ramp = float(rng.choice([0.0, 0.0, 30.0]))

    def at(part: float) -> Machine:
        left = [1.0, 1.0]
        left[which] = 1.0 - part * (1.0 - size)
        if b.geometry.supports[0].pedestal_stiffness_n_m is not None:
            return b.machine(pedestal=tuple(left))
        return b.machine(stiffness=tuple(left))

    return size, b.ramp(at, ramp)


def _softer_supports(b: Bench, rng: np.random.Generator) -> Fault:
    size = rng.uniform(0.4, 0.7)
    if b.geometry.supports[0].pedestal_stiffness_n_m is not None:
        return size, [b.stage(ONSET_REV, b.machine(pedestal=(size, size)))]
    return size, [b.stage(ONSET_REV, b.machine(stiffness=(size, size)))]


def _static_load(b: Bench, rng: np.random.Generator) -> Fault:
    size = rng.uniform(0.1, 0.4)
    angle = rng.uniform(-math.pi, math.pi)
    return size, [b.stage(ONSET_REV, b.machine(load_weight=size, load_angle_rad=angle))]


def _rub(b: Bench, rng: np.random.Generator, offset: float, depth: float) -> Fault:
    """A stator moves in until the healthy orbit would lie inside it by a part of the whirl."""
    towards = np.exp(1j * rng.uniform(-math.pi, math.pi))
    centre = b.rest_rub - offset * b.whirl_rub_m * towards
    theta = np.linspace(0.0, 2.0 * math.pi, 256)
    x, y = ((part * np.exp(1j * theta)).real for part in b.orbit_rub)
    reach = float(np.abs(b.rest_rub + x + 1j * y - centre).max())
    modal = (sum(b.healthy.disc_masses_kg) + 0.3 * b.healthy.weight_n / GRAVITY_M_S2) * b.critical[0] ** 2
    contact = Contact(
        centre=centre,
        clearance_m=reach - depth * b.whirl_rub_m,
        stiffness_n_m=rng.uniform(0.4, 2.5) * modal,
        friction=rng.uniform(0.05, 0.25),
    )
    return depth, [b.stage(ONSET_REV, contact=contact)]


def _light_rub(b: Bench, rng: np.random.Generator) -> Fault:
    return _rub(b, rng, offset=rng.uniform(0.5, 1.5), depth=rng.uniform(0.15, 0.35))


def _heavy_rub(b: Bench, rng: np.random.Generator) -> Fault:
    return _rub(b, rng, offset=rng.uniform(0.3, 1.0), depth=rng.uniform(0.35, 0.7))


def _wear(b: Bench, rng: np.random.Generator) -> Fault:
    size = rng.uniform(1.2, 1.5)
    return size, b.ramp(lambda part: b.machine(clearance=1.0 + part * (size - 1.0)), 40.0)


def _thin_oil(b: Bench, rng: np.random.Generator) -> Fault:
    size = rng.uniform(0.5, 0.75)
    return size, b.ramp(lambda part: b.machine(viscosity=1.0 - part * (1.0 - size)), 40.0)


def _misaligned(b: Bench, rng: np.random.Generator, place: str) -> Fault:
    """Forces of a coupling: twice a revolution, some once, and a constant one (Sekhar and Prabhu 1995)."""
    size = rng.uniform(0.2, 0.6)
    row = b.healthy.places[f"{place} x"] - 1j * b.healthy.places[f"{place} y"]
    turned = row * np.exp(2j * np.pi * rng.random())
    twice, once = (
        part * size * b.whirl_m / b.seen(row, order) * turned for part, order in ((1.0, 2), (0.4, 1))
    )
    forces = b.turning(once, twice)
    forces[0] = 0.5 * float(np.abs(twice).max() / np.abs(row).max()) * b.healthy.places[f"{place} y"]
    return size, [b.stage(ONSET_REV, turning=forces)]


def _parallel_misalignment(b: Bench, rng: np.random.Generator) -> Fault:
    return _misaligned(b, rng, "coupling")


def _angular_misalignment(b: Bench, rng: np.random.Generator) -> Fault:
    return _misaligned(b, rng, "tilt")


def _crack(b: Bench, rng: np.random.Generator) -> Fault:
    size = rng.uniform(0.3, 0.6)
    return size, [b.stage(ONSET_REV, crack=Crack(loss=size, angle_rad=rng.uniform(-math.pi, math.pi)))]


def _asymmetric_shaft(b: Bench, rng: np.random.Generator) -> Fault:
    size = rng.uniform(0.2, 0.4)
    crack = Crack(loss=size, angle_rad=rng.uniform(-math.pi, math.pi), breathes=False)
    return size, [b.stage(ONSET_REV, crack=crack)]


def _looseness(b: Bench, rng: np.random.Generator) -> Fault:
    size, which = rng.uniform(0.3, 0.7), int(rng.integers(2))
    support = b.geometry.supports[which]
    stiffness = support.stiffness_n_m[1] or 4.0 * b.healthy.weight_n / (1e-4)
    return size, [b.stage(ONSET_REV, loose=Loose(support=which, lost_n_m=size * stiffness))]


def _coupled_2x(b: Bench, rng: np.random.Generator) -> Fault:
    """Twice a revolution only, as a universal joint or an electric motor next door makes it."""
    size = rng.uniform(0.2, 0.6)
    row = b.healthy.places["coupling x"] + 0.0j
    twice = size * b.whirl_m / b.seen(row, 2) * np.exp(2j * np.pi * rng.random()) * row
    return size, [b.stage(ONSET_REV, turning=b.turning(twice=twice))]


FAULTS: dict[str, Callable[[Bench, np.random.Generator], Fault]] = {
    "unbalance": _unbalance,
    "thermal bow": _bow,
    "damping loss": _damping_loss,
    "one support softer": _softer_support,
    "both supports softer": _softer_supports,
    "static load": _static_load,
    "light rub": _light_rub,
    "heavy rub": _heavy_rub,
    "bearing wear": _wear,
    "thin oil": _thin_oil,
    "parallel misalignment": _parallel_misalignment,
    "angular misalignment": _angular_misalignment,
    "breathing crack": _crack,
    "asymmetric shaft": _asymmetric_shaft,
    "looseness": _looseness,
    "coupled 2X": _coupled_2x,
}
_NEEDS_OIL = frozenset({"bearing wear", "thin oil"})
TWICE = frozenset(
    {"unbalance", "damping loss", "both supports softer", "static load", "light rub", "heavy rub"}
)
"""Faults of the paper: two records of each, with other figures."""


def _vector(motion: Motion, first_rev: int, last_rev: int) -> Complexes:
    part = slice(first_rev * PER_REV, last_rev * PER_REV)
    z, angle = motion.position_m[part], motion.angle_rad[part]
    return np.array([np.mean(z * np.exp(-1j * k * angle)) for k in (0, 1, -1, 2, -2)])


def _recorded(folder: Path, b: Bench, fault: str, copy: int) -> Case | None:
    """Make a record; None if the machine with this fault runs away: its protection would have stopped it."""
    name = f"{b.geometry.name} {b.of_critical} {fault} {copy}".replace(" ", "-")
    rng = np.random.default_rng(zlib.crc32(name.encode()))
    healthy = fault == "healthy"
    size, stages = (0.0, []) if healthy else FAULTS[fault](b, rng)
    if not all(stable(stage.machine) for stage in stages):
        return None
    hunts = bool(rng.random() < 0.4) or (healthy and copy == 0)
    hunting = np.array([HUNTING if hunts else 0.0, rng.uniform(40.0, 120.0)])
    motion = move([b.stage(-math.inf), *stages], b.speed_rad_s, REVOLUTIONS, hunting)
    if not np.abs(motion.position_m - motion.position_m[0]).max() < _STOPPED * b.whirl_m:
        return None
    before, after = _vector(motion, 20, ONSET_REV - 10), _vector(motion, REVOLUTIONS - 80, REVOLUTIONS)
    whirl = float(np.sqrt((np.abs(before[1:]) ** 2).sum()))
    z = motion.position_m * 1e6
    for probe in (1.0, 1.0j):
        for order in (1, 2, 3):
            part = RUNOUT / order * 1e6 * whirl * np.exp(2j * np.pi * rng.random())
            z = z + probe * (part * np.exp(1j * order * motion.angle_rad)).real
    if healthy or rng.random() < 0.3:
        warm = 1.0 - np.exp(-np.arange(len(z)) / (rng.uniform(60.0, 300.0) * PER_REV))
        z = z + DRIFT_UM * np.exp(2j * np.pi * rng.random()) * warm
    np.savez_compressed(
        folder / f"{name}.npz",
        z_um=z.astype(np.complex64),
        angle_rad=motion.angle_rad,
        rate_hz=motion.rate_hz,
    )
    return Case(
        name, b.geometry.name, b.geometry.part, b.speed_rad_s * 30.0 / math.pi, b.of_critical, fault,
        float(ONSET_REV), size, b.critical[0] / (2.0 * math.pi), b.critical[1], b.clearance_um,
        0.0 if healthy else float(np.sqrt((np.abs(after - before) ** 2).sum())) / whirl, hunts,
    )  # fmt: skip


def _of_geometry(folder: Path, geometry: Geometry) -> list[Case]:
    model = Model(geometry)
    critical = model.first_critical()
    oil = geometry.supports[0].journal is not None
    cases = []
    for of_critical in geometry.of_speeds:
        b = Bench(model, of_critical, critical)
        for fault in ("healthy", *FAULTS):
            if fault in _NEEDS_OIL and not oil:
                continue
            for copy in range(2 if fault in TWICE or fault == "healthy" else 1):
                if case := _recorded(folder, b, fault, copy):
                    cases.append(case)  # noqa: PERF401 - three loops in one line are not read
    return cases


def main(arguments: list[str]) -> int:
    """Write all records."""
    folder = Path(arguments[0])
    folder.mkdir(parents=True, exist_ok=True)
    geometries = (*GEOMETRIES, *drawn())
    with ProcessPoolExecutor(2) as pool:
        made = pool.map(_of_geometry, [folder] * len(geometries), geometries)
        cases = [case for of_one in made for case in of_one]
    (folder / "cases.json").write_text(json.dumps([asdict(case) for case in cases], indent=1) + "\n")
    print(f"{len(cases)} records of {len(geometries)} machines in {folder}")  # noqa: T201
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
