"""Records for the live bank: the run-up of every geometry, and each change that the bank has a mode for.

    python -m plants.bank_records FOLDER      writes one ``.npz`` a record, and ``bank.json``

The machine is that of `plants.records`: below, at and above its first critical speed, with runout. Each
change is abrupt, and one that an observer can stand for: the unbalance grows where it is, all dampers lose
the same part, both supports get softer, the weight gets company, and an unbalance makes the shaft touch its
stator.
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
from plants.machines import GEOMETRIES, Condition, Geometry, Model, unbalance_force
from plants.records import RUNOUT
from plants.simulate import Contact, Stage, move, run_through
from plants.timing import ONSET_REV, REVOLUTIONS

if TYPE_CHECKING:
    from collections.abc import Callable

RUN_UP_FROM, RUN_UP_TO, RUN_UP_STEPS = 0.25, 1.55, 130
"""Speeds of a run-up, in parts of the first critical speed, and the steps that oil films change in."""
_RUN_UP_REVOLUTIONS = 1500
CLEARANCE = 3.0
"""Room that sag leaves between shaft and stator, in healthy orbits."""
STATOR = 2.0
"""Stiffness of the stator over that of the shaft."""
FRICTION = 0.1
_STOPPED = 100.0
"""No machine goes on with an orbit so many times the healthy one; what touches its stator goes far, too."""


@dataclass(frozen=True, slots=True)
class BankCase:
    """A record and what is true of it.

    Attributes:
        name: of the file.
        geometry: of the machine.
        part: of the bench that it belongs to.
        speed_rpm: shaft speed.
        of_critical: the same in parts of the first critical speed.
        fault: what happens: ``healthy``, or a fault of the bank.
        size: of it.
        whirl_um: healthy orbit at the probes.
        clearance_um: of the stator about the unbent shaft, as it would be at the probes.
        critical_hz: first critical speed.
        damping_ratio: by the width of its peak.
    """

    name: str
    geometry: str
    part: str
    speed_rpm: float
    of_critical: float
    fault: str
    size: float
    whirl_um: float
    clearance_um: float
    critical_hz: float
    damping_ratio: float


def _unbalance(b: Bench, size: float) -> Stage:
    return b.stage(ONSET_REV, turning=b.turning((size - 1.0) * b.unbalance))


def _damping_loss(b: Bench, size: float) -> Stage:
    if b.geometry.supports[0].journal is not None:
        damping = b.healthy.damping
        lost = (1.0 - size) * (damping + damping.T) / 4.0
        return b.stage(ONSET_REV, replace(b.healthy, damping=damping - lost))
    return b.stage(ONSET_REV, b.machine(damping=size))


def _stiffness_loss(b: Bench, size: float) -> Stage:
    if b.geometry.supports[0].pedestal_stiffness_n_m is not None:
        return b.stage(ONSET_REV, b.machine(pedestal=(size, size)))
    return b.stage(ONSET_REV, b.machine(stiffness=(size, size)))


def _static_load(b: Bench, size: float) -> Stage:
    # As much as the weight's own part that bends the shaft by so many healthy orbits at the probes.
    one = b.machine(load_weight=1.0)
    moved = abs((one.rest - b.healthy.rest) @ b.healthy.places["probe y"])
    return b.stage(ONSET_REV, b.machine(load_weight=size * b.whirl_m / float(moved)))


def _load_aside(b: Bench, size: float) -> Stage:
    # Gears and belts load from where they are: any direction, by lot.
    name = f"{b.geometry.name} {b.of_critical} {size}"
    angle = np.random.default_rng(zlib.crc32(name.encode())).uniform(-math.pi, math.pi)
    one = b.machine(load_weight=1.0, load_angle_rad=angle)
    moved = (one.rest - b.healthy.rest) @ np.stack([b.healthy.places[p] for p in ("probe x", "probe y")]).T
    part = size * b.whirl_m / float(np.linalg.norm(moved))
    return b.stage(ONSET_REV, b.machine(load_weight=part, load_angle_rad=angle))


def _rub(b: Bench, size: float) -> Stage:
    modal = (sum(b.healthy.disc_masses_kg) + 0.3 * b.healthy.weight_n / 9.80665) * b.critical[0] ** 2
    contact = Contact(
        centre=0j,
        clearance_m=abs(b.rest_rub) + CLEARANCE * b.whirl_rub_m,
        stiffness_n_m=STATOR * modal,
        friction=FRICTION,
    )
    return b.stage(ONSET_REV, turning=b.turning((size - 1.0) * b.unbalance), contact=contact)


FAULTS: dict[str, tuple[Callable[[Bench, float], Stage], tuple[float, ...]]] = {
    "unbalance": (_unbalance, (1.4, 1.8)),
    "damping_loss": (_damping_loss, (0.65, 0.45)),
    "stiffness_loss": (_stiffness_loss, (0.65, 0.45)),
    "static_load": (_static_load, (0.5, 1.0)),
    "static_load aside": (_load_aside, (0.5, 1.0)),
    "rub": (_rub, (4.5, 5.5)),
}


def _kept(folder: Path, b: Bench, fault: str, size: float, stages: list[Stage]) -> list[BankCase]:
    """A record; none if the machine with this fault runs away: its protection would have stopped it."""
    name = f"bank {b.geometry.name} {b.of_critical} {fault} {size}".replace(" ", "-")
    rng = np.random.default_rng(zlib.crc32(name.encode()))
    motion = move([b.stage(-math.inf), *stages], b.speed_rad_s, REVOLUTIONS, np.array([0.0, 50.0]))
    if not np.abs(motion.position_m - motion.position_m[0]).max() < _STOPPED * b.whirl_m:
        return []
    z = 1e6 * motion.position_m
    for probe in (1.0, 1.0j):
        for order in (1, 2, 3):
            part = RUNOUT / order * 1e6 * b.whirl_m * np.exp(2j * np.pi * rng.random())
            z = z + probe * (part * np.exp(1j * order * motion.angle_rad)).real
    np.savez_compressed(
        folder / f"{name}.npz",
        z_um=z.astype(np.complex64),
        angle_rad=motion.angle_rad,
        rate_hz=motion.rate_hz,
    )
    case = BankCase(
        name, b.geometry.name, b.geometry.part, b.speed_rad_s * 30.0 / math.pi, b.of_critical,
        fault.partition(" ")[0], size,
        1e6 * b.whirl_m, 1e6 * (abs(b.rest_probe) + CLEARANCE * b.whirl_m), b.critical[0] / (2.0 * math.pi),
        b.critical[1],
    )  # fmt: skip
    return [case]


def _run_up(folder: Path, model: Model, critical: float, scale: float) -> None:
    """The run-up: machines of many speeds, one after the other, and a speed that grows evenly."""
    geometry = model.geometry
    speeds = critical * np.linspace(RUN_UP_FROM, RUN_UP_TO, RUN_UP_STEPS)
    stages = []
    for speed in speeds:
        machine = model.machine(Condition(), float(speed))
        turning = np.zeros((3, len(machine.rest)), dtype=np.complex128)
        # The force is that of the present speed, not of the step's: it goes with its square.
        turning[1] = scale * unbalance_force(machine, geometry, float(speed)) / speed**2
        stages.append(Stage(begin_rev=-math.inf, machine=machine, turning=turning))
    motion = run_through(stages, speeds, _RUN_UP_REVOLUTIONS)
    name = f"bank {geometry.name} run-up".replace(" ", "-")
    rng = np.random.default_rng(zlib.crc32(name.encode()))
    z = 1e6 * motion.position_m
    whirl = 1e6 * float(np.std(motion.position_m))
    for probe in (1.0, 1.0j):
        for order in (1, 2, 3):
            part = RUNOUT / order * whirl * np.exp(2j * np.pi * rng.random())
            z = z + probe * (part * np.exp(1j * order * motion.angle_rad)).real
    np.savez_compressed(
        folder / f"{name}.npz",
        z_um=z.astype(np.complex64),
        angle_rad=motion.angle_rad,
        rate_hz=motion.rate_hz,
    )


def _of_geometry(folder: Path, geometry: Geometry) -> list[BankCase]:
    model = Model(geometry)
    critical = model.first_critical()
    _run_up(folder, model, critical[0], 1.0)
    cases = []
    for of_critical in geometry.of_speeds:
        b = Bench(model, of_critical, critical)
        cases += _kept(folder, b, "healthy", 0.0, [])
        for fault, (stage, sizes) in FAULTS.items():
            for size in sizes:
                cases += _kept(folder, b, fault, size, [stage(b, size)])
    return cases


def main(arguments: list[str]) -> int:
    """Write all records."""
    folder = Path(arguments[0])
    folder.mkdir(parents=True, exist_ok=True)
    geometries = (*GEOMETRIES, *drawn())
    with ProcessPoolExecutor(2) as pool:
        made = pool.map(_of_geometry, [folder] * len(geometries), geometries)
        cases = [case for of_one in made for case in of_one]
    (folder / "bank.json").write_text(json.dumps([asdict(case) for case in cases], indent=1) + "\n")
    print(f"{len(cases)} records for the bank in {folder}")  # noqa: T201
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
