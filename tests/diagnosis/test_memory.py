"""What detectors remember: taken out of one and put into another, both go on alike to the last bit."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

import numpy as np
import pytest
from support.machine_files import MACHINES

from daqsvc.acquisition.samples import Window
from daqsvc.detectors.make import detectors
from daqsvc.diagnosis.memory import (
    DetectorMemory,
    MemoryNotFittingError,
    MemoryNotTakenError,
    put,
    taken_memory,
)
from daqsvc.publish.payloads import statement_document
from daqsvc.settings import load_machine_file
from sim_hw.demo.machines import laval_rig
from sim_hw.scenario import load_scenario

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from daqsvc.acquisition.samples import Samples
    from daqsvc.diagnosis.detector import Detector
    from daqsvc.settings import MachineFile

SCENARIO = load_scenario("paper")
RUN = SCENARIO.simulate(3)


def rig() -> tuple[MachineFile, Samples]:
    """The paper's rotor, seen by probes: faults come on one after the other."""
    samples = np.column_stack([RUN.channels[name] for name in ("x_um", "y_um", "keyphasor_v")])
    return laval_rig(SCENARIO, RUN.noise_um, "mqtt://localhost"), samples.astype(np.float32)


def example(name: str) -> MachineFile:
    return load_machine_file(MACHINES / name)


def windows(detector: Detector, samples: Samples, rate_hz: float, blocks: int = 3) -> Iterator[Window]:
    step = blocks * detector.block
    period_ns = 1e9 / rate_hz
    for first in range(0, len(samples) - step + 1, step):
        end_ns = round((first + step - 1) * period_ns)
        yield Window(first, samples[first : first + step], end_ns, period_ns)


def told(detector: Detector, several: Sequence[Window]) -> str:
    said = [statement_document(one) for window in several for one in detector.process(window)]
    return json.dumps(said)


def goes_on_alike(machine: MachineFile, name: str, samples: Samples, share: float) -> str:
    """Have a detector process a share of a run; another one that remembers that goes on with the rest.

    Returns:
        What both say of the rest.
    """

    def made() -> Detector:
        return next(one for one in detectors(machine) if one.name == name)

    one, other = made(), made()
    rate_hz = machine.streams[one.stream].rate_hz
    all_windows = list(windows(one, samples, rate_hz))
    cut = round(share * len(all_windows))
    told(one, all_windows[:cut])
    memory = DetectorMemory.of(json.loads(json.dumps(taken_memory(one).document())))
    put(other, memory)
    rest = told(one, all_windows[cut:])
    assert rest == told(other, all_windows[cut:])
    assert json.dumps(taken_memory(one).document()) == json.dumps(taken_memory(other).document())
    return rest


@pytest.mark.parametrize("share", [pytest.param(0.3, marks=pytest.mark.long), 0.62])
def test_the_observers_of_a_rotor_go_on(share: float) -> None:
    machine, samples = rig()
    rest = goes_on_alike(machine, "rotor-bank", samples, share)
    assert "F1L3" in rest
    fresh = next(one for one in detectors(machine) if one.name == "rotor-bank")
    later = list(windows(fresh, samples, machine.streams["shaft"].rate_hz))
    assert rest != told(fresh, later[round(share * len(later)) :]), "memory makes a difference"


def test_the_levels_of_a_rotor_go_on() -> None:
    machine, samples = rig()
    [levels] = [one.name for one in detectors(machine) if one.name.startswith("levels")]
    assert "rms" in goes_on_alike(machine, levels, samples, 0.5)


@pytest.mark.long
def test_the_vector_of_a_rotor_goes_on() -> None:
    machine = example("rotor-synchronous.toml")
    rate_hz = machine.streams["shaft"].rate_hz
    turns = abs(machine.machine.speed_rpm) / 60.0
    t = np.arange(round(60 * rate_hz)) / rate_hz
    rng = np.random.default_rng(4)
    growth = 1.0 + np.clip(t - 30.0, 0.0, None) / 20.0
    x = 12.0 * growth * np.cos(2 * np.pi * turns * t) + rng.normal(0, 0.3, len(t))
    y = 11.0 * growth * np.sin(2 * np.pi * turns * t) + rng.normal(0, 0.3, len(t))
    key = np.where((turns * t) % 1.0 < 0.05, -12.0, -6.0)
    samples = np.column_stack([x, y, key]).astype(np.float32)
    for share in (0.1, 0.4, 0.7):
        assert goes_on_alike(machine, "rotor-synchronous", samples, share)


@pytest.mark.long
def test_a_bearing_goes_on() -> None:
    machine = example("bearing.toml")
    detector = next(one for one in detectors(machine) if one.name.startswith("bearing"))
    rate_hz = machine.streams[detector.stream].rate_hz
    channels = len(machine.streams[detector.stream].layout.channel_names)
    rng = np.random.default_rng(5)
    samples = rng.normal(0, 1, (round(40 * rate_hz), channels)).astype(np.float32)
    samples[round(30 * rate_hz) :] *= 3.0
    for share in (0.9,):
        assert goes_on_alike(machine, detector.name, samples, share)


def test_it_fits_its_own_kind_only() -> None:
    machine, samples = rig()
    bank, levels = (
        next(one for one in detectors(machine) if one.name.startswith(name)) for name in ("rotor", "levels")
    )
    told(levels, list(windows(levels, samples, 640.0))[:2])
    with pytest.raises(MemoryNotFittingError):
        put(bank, DetectorMemory(["object", "daqsvc.box:Box", {}, 0], []))
    with pytest.raises(MemoryNotFittingError):
        put(bank, DetectorMemory(["object", "os:_Environ", {}, 0], []))
    with pytest.raises(MemoryNotFittingError):
        DetectorMemory.of({"tree": 0, "arrays": [["O", [1], ""]]})


def test_what_is_too_much_is_not_taken() -> None:
    class Hoarder:
        __module__ = "daqsvc.tests"

        def __init__(self) -> None:
            self.all = np.zeros(2_000_000)

    with pytest.raises(MemoryNotTakenError, match="8 MB"):
        taken_memory(Hoarder())
