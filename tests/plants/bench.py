"""One geometry at one speed: its healthy motion, and the stages that its faults are made of."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from plants.machines import Condition, Machine, Model, unbalance_force
from plants.simulate import Stage
from plants.timing import ONSET_REV

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    Complexes = NDArray[np.complex128]

_RAMP_STEPS = 16
_LARGEST_WHIRL_M = 60e-6


class Bench:
    """One geometry at one speed, with its healthy motion."""

    def __init__(self, model: Model, of_critical: float, critical: tuple[float, float]) -> None:
        self.model, self.geometry = model, model.geometry
        self.of_critical, self.critical = of_critical, critical
        self.speed_rad_s = of_critical * critical[0]
        self.healthy = model.machine(Condition(), self.speed_rad_s)
        self.unbalance = unbalance_force(self.healthy, self.geometry, self.speed_rad_s)
        # A machine that runs near its critical speed is balanced for it.
        self.unbalance *= min(1.0, _LARGEST_WHIRL_M / self.seen(self.unbalance, 1))
        q = self.response(self.unbalance)
        self.orbit_rub = q @ self.healthy.places["rub x"], q @ self.healthy.places["rub y"]
        self.whirl_rub_m = float(max(abs(part) for part in self.orbit_rub))
        self.rest_rub, self.rest_probe = self._rest("rub"), self._rest("probe")
        self.whirl_m = self.seen(self.unbalance, 1)
        self.clearance_um = 1e6 * (2.0 * abs(self._rest("probe")) + 5.0 * self.whirl_m)

    def _rest(self, place: str) -> complex:
        return complex(*(self.healthy.rest @ self.healthy.places[f"{place} {axis}"] for axis in "xy"))

    def response(self, force: Complexes, order: int = 1) -> Complexes:
        """Motion of the shapes by a force that turns at so many times the shaft speed."""
        m, w = self.healthy, order * self.speed_rad_s
        damping = m.damping * 1j * w
        return np.asarray(np.linalg.solve(m.stiffness - w**2 * m.mass + damping, force))

    def seen(self, force: Complexes, order: int) -> float:
        """Size of what the probes see of a force that turns at so many times the shaft speed, m."""
        q = self.response(force, order)
        x, y = q @ self.healthy.places["probe x"], q @ self.healthy.places["probe y"]
        return float(np.hypot(abs(x + 1j * y), abs(x - 1j * y)) / 2.0)

    def machine(self, **changes: object) -> Machine:
        """The machine in another condition."""
        return self.model.machine(Condition(**changes), self.speed_rad_s)

    def turning(self, once: Complexes | None = None, twice: Complexes | None = None) -> Complexes:
        """Forces at 0, 1 and 2 times the shaft speed: the residual unbalance, and what is added."""
        forces = np.zeros((3, len(self.unbalance)), dtype=np.complex128)
        forces[1] = self.unbalance if once is None else self.unbalance + once
        if twice is not None:
            forces[2] = twice
        return forces

    def stage(self, begin_rev: float, machine: Machine | None = None, **parts: object) -> Stage:
        """A stage with the residual unbalance."""
        turning = parts.pop("turning", None)
        return Stage(
            begin_rev=begin_rev,
            machine=machine or self.healthy,
            turning=self.turning() if turning is None else turning,
            **parts,
        )

    def ramp(self, machine: Callable[[float], Machine], revolutions: float) -> list[Stage]:
        """Stages from healthy to a fault, by parts of it; all at once if it takes no time."""
        if not revolutions:
            return [self.stage(ONSET_REV, machine(1.0))]
        steps = np.arange(1, _RAMP_STEPS + 1) / _RAMP_STEPS
        return [self.stage(ONSET_REV + revolutions * part, machine(float(part))) for part in steps]
