"""Scenario files: a machine, what goes wrong with it and when, its sensors' noise and its link's faults.

A scenario is a TOML file; the ones that come with the package are known by their names. Angles of the
schedule are revolutions of the shaft, parameters are the paper's dimensionless ones.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, TypeAlias, TypeVar

import numpy as np
from pydantic import Field, ValidationError, model_validator

from daqsvc.confined.small_toml import TomlFileError, parse_toml, read_toml
from sim_hw.plants.rotor import Change, PlantParameters, simulate
from sim_hw.plants.sensors import keyphasor_voltage, noise_sigma
from sim_hw.scenario_bearing import BearingScenario
from sim_hw.scenario_faults import FaultTable, LinkFaultRates, ScenarioTable, planned_faults

if TYPE_CHECKING:
    from importlib.resources.abc import Traversable
    from typing import Self

    from numpy.typing import NDArray
    from pydantic_core import ErrorDetails

    from sim_hw.link_faults import LinkFaults
    from sim_hw.node_faults import NodeFaults

    Floats: TypeAlias = NDArray[np.float64]

_BUILTIN = "scenarios"
_Kind = TypeVar("_Kind", bound=ScenarioTable)


class ScenarioError(ValueError):
    """A scenario cannot be found, read or understood."""


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
    """What the sensors of a simulated machine said, and what really happened to it.

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
    band up to half the sampling rate; the noise stays the same when the machine gets worse.
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
        motion = simulate(
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

    def link(self, seed: int | None = None) -> LinkFaults | None:
        """The scenario's link, or None if nothing is wrong with it."""
        return (
            None
            if self.link_faults is None
            else self.link_faults.for_seed(self.seed if seed is None else seed)
        )

    def node_faults(self, seed: int | None = None) -> NodeFaults | None:
        """What goes wrong with nodes and link, `link` included; None if nothing does."""
        return planned_faults(self.fault, self.link_faults, self.seed if seed is None else seed)


def builtin_scenarios() -> list[str]:
    """Names of the scenarios that come with the package."""
    return sorted(_builtin_files())


def load_scenario(name_or_path: str | Path) -> Scenario:
    """Read a scenario of a rotor by its name, or from a file.

    Args:
        name_or_path: one of `builtin_scenarios`, or the path of a TOML file.

    Raises:
        ScenarioError: there is no such scenario, or the file is not one; says all that is wrong.
    """
    return _understood(Scenario, _table(name_or_path), name_or_path)


def load_any_scenario(name_or_path: str | Path) -> Scenario | BearingScenario:
    """As `load_scenario`, whatever the plant is."""
    table = _table(name_or_path)
    plant = table.get("plant")
    if isinstance(plant, dict) and plant.get("kind") == "bearing":
        return _understood(BearingScenario, table, name_or_path)
    return _understood(Scenario, table, name_or_path)


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
