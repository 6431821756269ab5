"""The imbalance levels of a measured rig against its balanced run, and that run against itself.

ADI's machinery fault simulator (`adi_cbm`): three-axis accelerometer, no keyphasor, 2 s each. Beside it, 1600
simulated pairs of unchanged machines at the default false-alarm probability of 1e-3. None of them alarms, as
the scatter allows for drift that they do not have; the bound of the test is that of the stated probability.
"""

# ruff: noqa: T201 - the figures are part of what it is for

from __future__ import annotations

import itertools
from functools import cache
from typing import TYPE_CHECKING

import numpy as np
import pytest
from scipy.signal import lfilter

from daqsvc.dsp.orders import order_vectors
from daqsvc.recording.recording import load_recording
from daqsvc.rotor.orders import compare_orders

if TYPE_CHECKING:
    from pathlib import Path

    from daqsvc.dsp.orders import OrderVectors

RATE_HZ = 20_000.0
LEVELS = ("VLIL", "LImL", "HImL", "VHIL")
AXES = {"XYZ": (0, 1, 2), "XY": (0, 1), "X": (0,), "Y": (1,), "Z": (2,)}

pytestmark = [pytest.mark.statistical, pytest.mark.data]


@cache
def samples(folder: Path, name: str) -> np.ndarray:
    channels = {"X": "1", "Y": "2", "Z": "3"}
    return load_recording(folder / f"{name}.Wfm.csv.gz", channels, RATE_HZ).samples


@cache
def orders(folder: Path, name: str, axes: str = "XYZ", part: int = 0, parts: int = 1) -> OrderVectors:
    whole = samples(folder, name)
    length = len(whole) // parts
    piece = whole[part * length : (part + 1) * length, AXES[axes]]
    return order_vectors(piece, RATE_HZ, float(name[:4]))


@pytest.fixture
def folder(data: Path) -> Path:
    return data / "adi_cbm" / "Data_ADXL356C"


def balanced(speed: str) -> str:
    return f"{speed}_GoB_GS_BaLo_WA_00lb"


@pytest.mark.parametrize("speed", ["1800", "3000"])
def test_every_imbalance_level_is_a_growing_1x(folder: Path, speed: str) -> None:
    healthy = orders(folder, balanced(speed))
    growth = []
    for level in LEVELS:
        change = compare_orders(healthy, orders(folder, f"{speed}_GoB_GS_{level}_WA_00lb"))
        assert change.group == ("unbalance", "damping_loss"), level
        assert change.growth_significant
        growth.append(change.growth)
    assert growth == sorted(growth)
    assert growth[0] > 3.0


@pytest.mark.parametrize("speed", ["1800", "3000"])
@pytest.mark.parametrize("parts", [2, 4])
@pytest.mark.parametrize("axes", ["XYZ", "XY", "X", "Y"])
def test_half_a_second_is_enough(folder: Path, speed: str, parts: int, axes: str) -> None:
    # One radial axis alone, and a quarter of each recording against each quarter of the balanced one.
    for level, i, j in itertools.product(LEVELS, range(parts), range(parts)):
        change = compare_orders(
            orders(folder, balanced(speed), axes, i, parts),
            orders(folder, f"{speed}_GoB_GS_{level}_WA_00lb", axes, j, parts),
        )
        assert change.verdict == "unbalance", (level, i, j)


@pytest.mark.parametrize("parts", [2, 4])
@pytest.mark.parametrize("axes", AXES)
def test_no_part_of_any_run_differs_from_another(folder: Path, parts: int, axes: str) -> None:
    # All 20 runs, whatever is wrong with them: a machine is always the same as itself.
    wrong = []
    pairs = 0
    for path in sorted(folder.glob("*.gz")):
        name = path.name.split(".")[0]
        for i, j in itertools.permutations(range(parts), 2):
            change = compare_orders(
                orders(folder, name, axes, i, parts), orders(folder, name, axes, j, parts)
            )
            pairs += 1
            if change.verdict != "normal":
                wrong.append((name, i, j, change.verdict))
    assert pairs == 20 * parts * (parts - 1)
    assert not wrong


@pytest.mark.parametrize("speed", ["1800", "3000"])
@pytest.mark.parametrize("condition", ["BS_BaLo_WA", "GS_BaLo_MA"])
def test_bent_shaft_and_misalignment_are_no_unbalance(folder: Path, speed: str, condition: str) -> None:
    change = compare_orders(orders(folder, balanced(speed)), orders(folder, f"{speed}_GoB_{condition}_00lb"))
    assert change.group == ("unmodelled",)
    assert not change.growth_significant


def test_no_bearing_fault_is_an_unbalance(folder: Path) -> None:
    # Another bearing and 11 lb more on the shaft: a change, perhaps, but not of 1X.
    for path in sorted(folder.glob("1800_*_11lb*")):
        change = compare_orders(orders(folder, balanced("1800")), orders(folder, path.name.split(".")[0]))
        assert change.verdict in {"normal", "unmodelled"}, path.name


@pytest.mark.parametrize("nominal_rpm", [1500.0, 1900.0, 2400.0, 3200.0])
def test_a_wrong_speed_is_named(folder: Path, nominal_rpm: float) -> None:
    for level in LEVELS:
        with pytest.raises(ValueError, match=r"the shaft turns at about 18\d\d rpm by its harmonics"):
            order_vectors(samples(folder, f"1800_GoB_GS_{level}_WA_00lb"), RATE_HZ, nominal_rpm)


@pytest.mark.parametrize("rpm", [600.0, 1800.0])
@pytest.mark.parametrize("colour", ["white", "resonant"])
@pytest.mark.parametrize("level", [0.0, 0.3, 1.0, 10.0])
def test_false_alarms_stay_below_their_probability(rpm: float, colour: str, level: float) -> None:
    rng = np.random.default_rng([int(rpm), int(10 * level), len(colour)])
    alarms = sum(
        compare_orders(*(simulated(rng, rpm, colour, level) for _ in range(2))).verdict != "normal"
        for _ in range(100)
    )
    print(
        f"{alarms} false alarms in 100 pairs: {rpm:g} rpm, {colour} noise, orders {level:g} times the noise"
    )
    # P(more than 2 of 100 at 1e-3) = 1.5e-4, in 16 cases 0.25 %
    assert alarms <= 2


def simulated(rng: np.random.Generator, rpm: float, colour: str, level: float) -> OrderVectors:
    rate_hz, n = 2000.0, 4000
    true_rpm = rpm * (1.0 + 0.002 * rng.standard_normal())
    angle = rng.uniform(0.0, 2.0 * np.pi) + 2.0 * np.pi * true_rpm / 60.0 / rate_hz * np.arange(n)
    noise = rng.standard_normal((n, 3))
    if colour == "resonant":
        noise = 0.1 * lfilter([1.0], [1.0, -1.8, 0.9], noise, axis=0)
    shape = np.array([1.0, 0.7j, 0.3])
    for order, amplitude in enumerate((1.0, 0.4, 0.2), 1):
        noise += level * amplitude * np.real(np.outer(np.exp(1j * order * angle), shape))
    return order_vectors(noise, rate_hz, rpm)
