"""Scenarios of a machine with one rolling element bearing: which of its parts are damaged, and when."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, Literal, TypeAlias

import numpy as np
from pydantic import Field, model_validator

from sim_hw.plants.bearing import BearingMachine, FaultSignal, NoiseLevels, levels, simulate
from sim_hw.scenario_faults import FaultTable, LinkFaultRates, ScenarioTable, planned_faults

if TYPE_CHECKING:
    from typing import Self

    from numpy.typing import NDArray

    from sim_hw.node_faults import NodeFaults
    from sim_hw.plants.bearing import Fault

    Floats: TypeAlias = NDArray[np.float64]

_SILENT = NoiseLevels((0.0, 0.0), 0.0)


class BearingPlant(ScenarioTable):
    """A machine by its masses, stiffnesses and dampings, in SI units.

    Those not given have the mode of its rolling elements at 4.2 kHz (the set ``S3`` of the bearing's model).
    Noise and unbalance are measured by the damage, so its depth scales all levels.

    Attributes:
        snr_db: power of the damage over the sensors' noise.
        spall_depth_um: how deep a rolling element dips into a spall.
        unbalance_ratio: amplitude of 1X at the rotor's sensor over the r.m.s. value of the damage there.
    """

    kind: Literal["bearing"]
    speed_rpm: float = Field(default=1797.0, gt=0, allow_inf_nan=False)
    masses_kg: tuple[float, float, float] = (2.0, 1.0, 2.0)
    stiffnesses_n_per_m: tuple[float, float, float] = (1.7765e8, 3.5531e8, 1.7765e8)
    dampings_n_s_per_m: tuple[float, float, float] = (753.98, 2513.27, 1256.64)
    snr_db: float = Field(default=10.0, allow_inf_nan=False)
    spall_depth_um: float = Field(default=2.0, gt=0, allow_inf_nan=False)
    unbalance_ratio: float = Field(default=3.0, ge=0, allow_inf_nan=False)

    @property
    def machine(self) -> BearingMachine:
        """Its arithmetic."""
        return BearingMachine(
            masses=self.masses_kg, stiffnesses=self.stiffnesses_n_per_m, dampings=self.dampings_n_s_per_m
        )


class RaceDamage(ScenarioTable):
    """From ``at_s`` on these parts are damaged, and no others."""

    part: Literal["healthy", "inner", "outer", "ball", "inner_and_outer"]
    at_s: float = Field(ge=0, allow_inf_nan=False)


class BearingScenario(ScenarioTable):
    """One scenario file whose plant is a bearing.

    Attributes:
        title: what it shows, in a line.
        seed: of every random draw, unless another is given.
        duration_s: length of the run.
        plant: the machine.
        damage: of its bearing, in order; healthy before the first.
        link_faults: what the link does wrong all the time.
        fault: what goes wrong with nodes and link, and when.
    """

    title: str
    seed: int = Field(default=1, ge=0)
    duration_s: float = Field(gt=0, le=3600)
    plant: BearingPlant
    damage: tuple[RaceDamage, ...] = ()
    link_faults: LinkFaultRates | None = None
    fault: tuple[FaultTable, ...] = ()

    @model_validator(mode="after")
    def _check_schedule(self) -> Self:
        times = [damage.at_s for damage in self.damage]
        if sorted(set(times)) != times or (times and times[-1] >= self.duration_s):
            raise ValueError(
                f"damage at {', '.join(f'{at:g}' for at in times)} s must rise and lie before the end, "
                f"duration_s = {self.duration_s:g}"
            )
        self.node_faults()
        return self

    def node_faults(self, seed: int | None = None) -> NodeFaults | None:
        """What goes wrong with nodes and link; None if nothing does."""
        return planned_faults(self.fault, self.link_faults, self.seed if seed is None else seed)

    def accelerations(
        self, rate_hz: float, seed: int | None = None, snr_db: float | None = None
    ) -> ScenarioRun:
        """Run the scenario; the same seed gives the same samples.

        Args:
            rate_hz: sampling rate.
            seed: instead of the scenario's.
            snr_db: instead of the plant's.
        """
        seed = self.seed if seed is None else seed
        signal = FaultSignal(shaft_hz=self.plant.speed_rpm / 60.0, depth_m=1e-6 * self.plant.spall_depth_um)
        level = levels(
            self.plant.machine,
            signal,
            snr_db=self.plant.snr_db if snr_db is None else snr_db,
            rate_hz=rate_hz,
            unbalance_ratio=self.plant.unbalance_ratio,
        )
        calm, *of_damage = (
            np.random.default_rng(s) for s in np.random.SeedSequence(seed).spawn(1 + len(self.damage))
        )

        def run(part: Fault, level: NoiseLevels, rng: np.random.Generator) -> Floats:
            machine = self.plant.machine
            return simulate(machine, signal, part, level, rng, seconds=self.duration_s, rate_hz=rate_hz).y

        # The machine is linear: its vibration is what it does when healthy, and what the damage adds.
        y = run("healthy", level, calm)
        borders_s = [*(damage.at_s for damage in self.damage), self.duration_s]
        for damage, (from_s, to_s), rng in zip(self.damage, pairwise(borders_s), of_damage, strict=True):
            part = slice(round(from_s * rate_hz), round(to_s * rate_hz))
            y[part] += run(damage.part, _SILENT, rng)[part]
        return ScenarioRun(rotor_m_s2=y[:, 0], housing_m_s2=y[:, 1])


@dataclass(frozen=True, slots=True)
class ScenarioRun:
    """What accelerometers on the rotor and on the housing said: float64 ``[n]`` each, in m/s^2."""

    rotor_m_s2: Floats
    housing_m_s2: Floats
