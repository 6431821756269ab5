"""Scenario files: a machine, what goes wrong with it and when, its sensors' noise and its link's faults.

A scenario is a TOML file; the ones that come with the package are known by their names. The plant is a
rotor (`Scenario`), whose schedule counts revolutions of the shaft and whose parameters are the paper's
dimensionless ones, or a machine with one rolling element bearing (`BearingScenario`). Both have
``[[fault]]`` tables: what goes wrong with nodes and their link.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace
from importlib import resources
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, NamedTuple, TypeAlias, TypeVar

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from daqsvc.confined.small_toml import TomlFileError, parse_toml, read_toml
from daqsvc.errors.command_line import SIMULATION
from sim_hw.link_faults import LinkFaults
from sim_hw.node_faults import EVER, Babble, Drift, FaultWindow, FrameDelay, NodeFaults
from sim_hw.plants import bearing, rotor
from sim_hw.plants.bearing import BearingMachine, FaultSignal, NoiseLevels
from sim_hw.plants.rotor import Change, PlantParameters, keyphasor_voltage, noise_sigma

if TYPE_CHECKING:
    from collections.abc import Sequence
    from importlib.resources.abc import Traversable
    from typing import Self

    from numpy.typing import NDArray
    from pydantic_core import ErrorDetails

    from sim_hw.plants.bearing import Fault

    Floats: TypeAlias = NDArray[np.float64]


Seconds = Annotated[float, Field(ge=0, allow_inf_nan=False)]
_MS_PER_S = 1000.0


class ScenarioTable(BaseModel):
    """A table of a scenario file: no key but those that are known."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class _Timed(ScenarioTable):
    """A fault from ``from_s`` to ``to_s`` of the playing; for all the rest of it unless ``to_s`` is given."""

    from_s: Seconds = 0.0
    to_s: Seconds | None = None

    @property
    def window(self) -> FaultWindow:
        """When it is there."""
        return FaultWindow(self.from_s, math.inf if self.to_s is None else self.to_s)

    @model_validator(mode="after")
    def _check(self) -> Self:
        planned_faults([self], None, 0)  # type: ignore[list-item]
        return self


class LinkFaultRates(ScenarioTable):
    """Probabilities per frame of what the link does wrong, see `LinkFaults`."""

    drop: float = 0.0
    duplicate: float = 0.0
    reorder: float = 0.0
    corrupt: float = 0.0
    reorder_within_ms: float = Field(default=5.0, ge=0, allow_inf_nan=False)

    @model_validator(mode="after")
    def _check_rates(self) -> Self:
        self.for_seed(0)
        return self

    def for_seed(self, seed: int) -> LinkFaults:
        """The link with its random draws fixed."""
        return LinkFaults(
            drop=self.drop,
            duplicate=self.duplicate,
            reorder=self.reorder,
            corrupt=self.corrupt,
            reorder_within_ns=round(self.reorder_within_ms * 1e6),
            seed=seed,
        )


class LinkTable(_Timed, LinkFaultRates):
    """The link drops, doubles, reorders or corrupts frames for a while."""

    kind: Literal["link"]


class DelayTable(_Timed):
    """Frames are late, by as much for each or by chance."""

    kind: Literal["delay"]
    delay_ms: Seconds = 0.0
    jitter_ms: Seconds = 0.0


class DriftTable(_Timed):
    """The clocks of the nodes are wrong."""

    kind: Literal["drift"]
    ppm: float


class SilenceTable(_Timed):
    """The nodes sample and send nothing."""

    kind: Literal["silence"]


class BrownOutTable(_Timed):
    """The nodes have no power, and count from 0 when they have it again."""

    kind: Literal["brown-out"]


class BabbleTable(_Timed):
    """Another node fills the bus with frames of its own."""

    kind: Literal["babble"]
    rate_hz: float = Field(gt=0)
    id: int = Field(default=0, ge=0, lt=2**11)


class CounterResetTable(ScenarioTable):
    """The nodes count from 0 again, without a pause."""

    kind: Literal["counter-reset"]
    at_s: float = Field(gt=0, allow_inf_nan=False)


FaultTable: TypeAlias = Annotated[
    LinkTable | DelayTable | DriftTable | SilenceTable | BrownOutTable | BabbleTable | CounterResetTable,
    Field(discriminator="kind"),
]


def planned_faults(
    tables: Sequence[FaultTable], always: LinkFaultRates | None, seed: int
) -> NodeFaults | None:
    """What goes wrong by the tables of a scenario; None if nothing does.

    Args:
        tables: its ``[[fault]]`` tables.
        always: its ``[link_faults]`` table: a link fault all the time.
        seed: of every random draw.

    Raises:
        ValueError: a table has an impossible value, or two of them contradict each other.
    """
    if not tables and always is None:
        return None
    link = [(EVER, always.for_seed(seed))] if always is not None else []
    link += [(t.window, t.for_seed(seed)) for t in tables if isinstance(t, LinkTable)]
    return NodeFaults(
        drift=[Drift(t.window, t.ppm) for t in tables if isinstance(t, DriftTable)],
        brown_out=[t.window for t in tables if isinstance(t, BrownOutTable)],
        counter_reset_s=[t.at_s for t in tables if isinstance(t, CounterResetTable)],
        silence=[t.window for t in tables if isinstance(t, SilenceTable)],
        link=link,
        delay=[
            FrameDelay(t.window, t.delay_ms / _MS_PER_S, t.jitter_ms / _MS_PER_S)
            for t in tables
            if isinstance(t, DelayTable)
        ],
        babble=[Babble(t.window, t.rate_hz, t.id) for t in tables if isinstance(t, BabbleTable)],
        seed=seed,
    )


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
        level = bearing.levels(
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
            return bearing.simulate(
                machine, signal, part, level, rng, seconds=self.duration_s, rate_hz=rate_hz
            ).y

        # The machine is linear: its vibration is what it does when healthy, and what the damage adds.
        y = run("healthy", level, calm)
        borders_s = [*(damage.at_s for damage in self.damage), self.duration_s]
        for damage, (from_s, to_s), rng in zip(self.damage, pairwise(borders_s), of_damage, strict=True):
            part = slice(round(from_s * rate_hz), round(to_s * rate_hz))
            y[part] += run(damage.part, _SILENT, rng)[part]
        return ScenarioRun(rotor_m_s2=y[:, 0], housing_m_s2=y[:, 1])


@dataclass(frozen=True, slots=True)
class ScenarioRun:
    """What accelerometers on the rotor and on the housing measured: float64 ``[n]`` each, in m/s^2."""

    rotor_m_s2: Floats
    housing_m_s2: Floats


_BUILTIN = "scenarios"
_Kind = TypeVar("_Kind", bound=ScenarioTable)


class ScenarioError(ValueError):
    """A scenario cannot be found, read or understood."""

    code = SIMULATION


class Onset(NamedTuple):
    """When a mode really began.

    Attributes:
        mode: its name.
        at_rev: shaft revolutions since the start.
        sample: the first sample taken in this mode.
    """

    mode: str
    at_rev: float
    sample: int


@dataclass(frozen=True, slots=True)
class SimulatedMachine:
    """What the sensors of a simulated machine measured, and what really happened to it.

    Attributes:
        channels: float64 ``[n]`` each: ``x_um`` and ``y_um``, displacement of the shaft at two proximity
            probes in micrometres; ``keyphasor_v``, voltage of the keyphasor probe.
        samples_per_rev: samples per revolution of the shaft.
        rate_hz: samples per second at the machine's speed.
        onsets: the modes in order, the healthy one first.
        revolutions: length of the run.
        noise_um: standard deviation of the noise in ``x_um`` and ``y_um``.
    """

    channels: dict[str, Floats]
    samples_per_rev: float
    rate_hz: float
    onsets: list[Onset]
    revolutions: float
    noise_um: float

    def __len__(self) -> int:
        return len(self.channels["keyphasor_v"])


class Plant(ScenarioTable):
    """The machine. Rotor parameters not given are the paper's (`PlantParameters`)."""

    kind: Literal["rotor"]
    healthy_mode: str = Field(default="N", min_length=1)
    speed_rpm: float = Field(default=600.0, gt=0, allow_inf_nan=False)
    clearance_um: float = Field(default=100.0, gt=0, allow_inf_nan=False)
    rotor: PlantParameters = PlantParameters()
    process_noise: float = Field(default=0.0, ge=0, allow_inf_nan=False)

    @model_validator(mode="before")
    @classmethod
    def _refuse_unknown_rotor_parameters(cls, table: object) -> object:
        if isinstance(table, dict) and isinstance(table.get("rotor"), dict):
            _check_names(table["rotor"])
        return table


class Noise(ScenarioTable):
    """Noise of the sensors.

    ``snr_db`` is the AC power of a channel in the healthy mode over the noise's variance, in the whole
    band up to half the sampling rate. The noise stays the same when the machine gets worse.
    """

    snr_db: float = Field(default=0.0, allow_inf_nan=False)
    keyphasor_v: float = Field(default=0.02, ge=0, allow_inf_nan=False)


class ScenarioMode(ScenarioTable):
    """A change of the machine: from ``at_rev`` on, ``change`` replaces these of its healthy parameters."""

    mode: str = Field(min_length=1)
    at_rev: float = Field(gt=0, allow_inf_nan=False)
    change: dict[str, float] = Field(min_length=1)

    @model_validator(mode="after")
    def _refuse_unknown_rotor_parameters(self) -> Self:
        _check_names(self.change)
        return self


class Scenario(ScenarioTable):
    """One scenario file.

    Attributes:
        title: what it shows, in a line.
        seed: of every random draw, unless another is given.
        revolutions: length of the run.
        samples_per_rev: sampling rate over shaft speed.
        dither_rev: onsets are moved by up to this much either way, differently for every seed, so
            that no detector profits from a grid they fall on.
        plant: the machine.
        noise: of its sensors.
        onset: what goes wrong with it, in order.
        link_faults: what the link does wrong all the time; None if it does nothing wrong.
        fault: what goes wrong with nodes and link, and when.
    """

    title: str
    seed: int = Field(default=1, ge=0)
    revolutions: float = Field(gt=0, allow_inf_nan=False)
    samples_per_rev: float = Field(default=64.0, gt=2, allow_inf_nan=False)
    dither_rev: float = Field(default=0.5, ge=0, allow_inf_nan=False)
    plant: Plant
    noise: Noise = Noise()
    onset: tuple[ScenarioMode, ...] = ()
    link_faults: LinkFaultRates | None = None
    fault: tuple[FaultTable, ...] = ()

    @model_validator(mode="after")
    def _check_schedule(self) -> Self:
        marks = [0.0, *(onset.at_rev for onset in self.onset), self.revolutions]
        # Neighbours may be dithered towards each other; the start and the end stand still.
        margin = [self.dither_rev, *[2 * self.dither_rev] * (len(self.onset) - 1), self.dither_rev]
        for i in range(len(marks) - 1) if self.onset else ():
            if marks[i + 1] - marks[i] <= margin[i]:
                raise ValueError(
                    f"revolutions {marks[i]:g} and {marks[i + 1]:g} are too close or out of order: "
                    f"onsets must rise between 0 and revolutions = {self.revolutions:g}, more than "
                    f"{margin[i]:g} apart with dither_rev = {self.dither_rev:g}"
                )
        for onset in self.onset:
            if "speed_ratio" in onset.change:
                raise ValueError(
                    f"onset {onset.mode!r} changes speed_ratio; the shaft's speed is constant in a scenario"
                )
            try:
                self._parameters(onset)
            except ValueError as error:
                raise ValueError(f"onset {onset.mode!r}: {error}") from error
        if not self.plant.rotor.eccentricity:
            raise ValueError(
                "plant.rotor.eccentricity is 0: without 1X vibration there is no signal-to-noise"
            )
        self.node_faults()
        return self

    def _parameters(self, onset: ScenarioMode) -> PlantParameters:
        return replace(self.plant.rotor, **onset.change)

    @property
    def rate_hz(self) -> float:
        """Samples per second at the machine's speed."""
        return self.samples_per_rev * self.plant.speed_rpm / 60.0

    def simulate(self, seed: int | None = None, snr_db: float | None = None) -> SimulatedMachine:
        """Run the scenario; the same seed gives the same samples.

        Args:
            seed: instead of the scenario's.
            snr_db: instead of the scenario's.

        Raises:
            RotorEscapeError: the scenario's rotor leaves its housing.
        """
        seed = self.seed if seed is None else seed
        snr_db = self.noise.snr_db if snr_db is None else snr_db
        # One stream of draws for each cause: changing one does not move the others.
        dither, process, sensors = (np.random.default_rng(s) for s in np.random.SeedSequence(seed).spawn(3))
        shifts = dither.uniform(-self.dither_rev, self.dither_rev, len(self.onset))
        begins = [onset.at_rev + shift for onset, shift in zip(self.onset, shifts.tolist(), strict=True)]
        motion = rotor.simulate(
            self.plant.rotor,
            [Change(at, self._parameters(onset)) for at, onset in zip(begins, self.onset, strict=True)],
            revolutions=self.revolutions,
            samples_per_rev=self.samples_per_rev,
            process_noise=self.plant.process_noise,
            rng=process,
        )
        x_um, y_um = motion.in_um(self.plant.clearance_um)
        sigma_um = noise_sigma(abs(self.plant.rotor.orbit_1x) * self.plant.clearance_um, snr_db)
        n = len(motion.revolution)
        noise = sensors.normal(size=(3, n))
        modes = [self.plant.healthy_mode, *(onset.mode for onset in self.onset)]
        return SimulatedMachine(
            channels={
                "x_um": x_um + sigma_um * noise[0],
                "y_um": y_um + sigma_um * noise[1],
                "keyphasor_v": keyphasor_voltage(motion.revolution) + self.noise.keyphasor_v * noise[2],
            },
            samples_per_rev=self.samples_per_rev,
            rate_hz=self.rate_hz,
            onsets=[
                Onset(mode, at, int(np.searchsorted(motion.revolution, at)))
                for mode, at in zip(modes, [0.0, *begins], strict=True)
            ],
            revolutions=self.revolutions,
            noise_um=sigma_um,
        )

    def node_faults(self, seed: int | None = None) -> NodeFaults | None:
        """What goes wrong with nodes and link; None if nothing does."""
        return planned_faults(self.fault, self.link_faults, self.seed if seed is None else seed)


_BY_PLANT: dict[str, type[Scenario | BearingScenario]] = {"rotor": Scenario, "bearing": BearingScenario}
"""What a file is by its plant; one that is neither is refused as a rotor's."""


def builtin_scenarios() -> list[str]:
    """Names of the scenarios that come with the package."""
    return sorted(_builtin_files())


def load_scenario(name_or_path: str | Path) -> Scenario:
    """Read a scenario of a rotor by its name, or from a file.

    Args:
        name_or_path: one of `builtin_scenarios`, or the path of a TOML file.

    Raises:
        ScenarioError: there is no such scenario, or the file is not one; states all that is wrong.
    """
    return _understood(Scenario, _table(name_or_path), name_or_path)


def load_any_scenario(name_or_path: str | Path) -> Scenario | BearingScenario:
    """As `load_scenario`, whatever the plant is."""
    table = _table(name_or_path)
    plant = table.get("plant")
    kind = plant.get("kind") if isinstance(plant, dict) else None
    return _understood(_BY_PLANT.get(str(kind), Scenario), table, name_or_path)


def _table(name_or_path: str | Path) -> dict[str, Any]:
    builtin = _builtin_files().get(str(name_or_path))
    source: Traversable = Path(name_or_path) if builtin is None else builtin
    try:
        return read_toml(source) if isinstance(source, Path) else parse_toml(source.read_text("utf-8"))
    except FileNotFoundError:
        raise ScenarioError(
            f"there is no scenario {str(name_or_path)!r}: neither a file nor one of "
            f"{', '.join(builtin_scenarios())}"
        ) from None
    except (OSError, TomlFileError) as error:
        raise ScenarioError(f"scenario {name_or_path} cannot be read: {error}") from error


def _understood(kind: type[_Kind], table: dict[str, Any], name_or_path: str | Path) -> _Kind:
    try:
        return kind.model_validate(table)
    except ValidationError as error:
        problems = "\n".join(_in_words(problem) for problem in error.errors())
        raise ScenarioError(f"scenario {name_or_path} cannot be understood:\n{problems}") from error


def _builtin_files() -> dict[str, Traversable]:
    folder = resources.files("sim_hw") / _BUILTIN
    return {file.name.removesuffix(".toml"): file for file in folder.iterdir() if file.name.endswith(".toml")}


def _check_names(parameters: dict[str, object] | dict[str, float]) -> None:
    known = [field.name for field in fields(PlantParameters)]
    unknown = [name for name in parameters if name not in known]
    if unknown:
        raise ValueError(
            f"{', '.join(unknown)}: no such parameter of the rotor; there are {', '.join(known)}"
        )


def _in_words(problem: ErrorDetails) -> str:
    key = ".".join(str(step) for step in problem["loc"]) or "the file"
    unknown = problem["type"] == "extra_forbidden"
    return f"  {key}: {'no such key' if unknown else problem['msg'].removeprefix('Value error, ')}"
