"""A measured rotor: the RK-4 kit's Bode plot, and its known changes of unbalance.

Both tables hold 1X only. That of the unbalance changes has no mean position (AC-coupled probes) and no 2X;
both are taken as unchanged, within the scatter of 1X. Its shaft turns from y to x.
"""

from __future__ import annotations

import csv
import itertools
from collections import defaultdict
from typing import TYPE_CHECKING

import numpy as np
import pytest

from daqsvc.rotor.calibration.bode import fit_bode
from daqsvc.rotor.laval import LavalRotor
from daqsvc.rotor.synchronous.baseline import Calibration
from daqsvc.rotor.synchronous.signatures import Identification, NamingRules, identify

if TYPE_CHECKING:
    from pathlib import Path

UM_PER_MIL = 25.4
CRITICAL_RPM, DAMPING = 1648.0, 0.04
STEADY_UP_TO_RPM = 1720.0
"""The run-up rings beyond: its vectors are no longer those of steady speeds."""

pytestmark = [pytest.mark.statistical, pytest.mark.data]


def table(path: Path) -> list[dict[str, str]]:
    with path.open(encoding="utf-8") as lines:
        return list(csv.DictReader(line for line in lines if not line.startswith("#")))


def bode(data: Path) -> tuple[np.ndarray, np.ndarray]:
    rows = table(data / "rk4_rotor_kit" / "runup_1x_bode_measured.csv")
    speed, amplitude, phase = (np.array([float(row[k]) for row in rows]) for k in rows[0])
    return speed, UM_PER_MIL * amplitude * np.exp(1j * np.radians(phase))


def test_the_model_reproduces_amplitude_and_phase_through_the_critical_speed(data: Path) -> None:
    """Measured: vector 3.8 %, amplitude 5.0 % rms, phase 2.6 degrees rms; 1639 rpm, 0.035; and 1695 rpm."""
    speed, vectors = bode(data)
    part = speed < STEADY_UP_TO_RPM
    fit = fit_bode(speed[part], vectors[part])
    assert fit.vector_error < 0.04
    assert fit.amplitude_error < 0.06
    assert fit.phase_error_deg < 3.0
    assert len(fit.gains) == 2
    assert fit.critical_speeds_rpm[0] == pytest.approx(CRITICAL_RPM, rel=0.01)
    assert fit.damping_ratios[0] == pytest.approx(DAMPING, rel=0.2)


def test_one_mode_does_not_explain_a_split_critical_speed(data: Path) -> None:
    speed, vectors = bode(data)
    part = speed < STEADY_UP_TO_RPM
    assert fit_bode(speed[part], vectors[part], modes=1).vector_error > 0.1


def test_what_rings_after_the_critical_speed_belongs_to_the_sweep(data: Path) -> None:
    """Its rate follows if there is one vector a revolution: n dn / 60. Measured: 20 % steady, 12 % swept."""
    speed, vectors = bode(data)
    sweep_rpm_per_s = float(np.diff(speed**2).mean()) / 120.0
    swept = fit_bode(speed, vectors, sweep_rpm_per_s=sweep_rpm_per_s)
    assert swept.vector_error < 0.13
    assert fit_bode(speed, vectors).vector_error > 1.5 * swept.vector_error


def acquisitions(data: Path, plane: int) -> dict[tuple[str, str], np.ndarray]:
    """Vectors of `HARMONICS` in um, complex128 ``[repeats, 5]``, by speed and condition."""
    found: dict[tuple[str, str], list[np.ndarray]] = defaultdict(list)
    for row in table(data / "rk4_rotor_kit" / "unbalance_response_1x_measured.csv"):
        x, y = (
            UM_PER_MIL * complex(float(row[f"p{plane}{axis}_re"]), float(row[f"p{plane}{axis}_im"]))
            for axis in "xy"
        )
        vector = np.array([0.0, (x - 1j * y) / 2.0, np.conj(x + 1j * y) / 2.0, 0.0, 0.0])
        found[row["speed_id"], row["condition"]].append(vector)
    return {key: np.array(vectors) for key, vectors in found.items()}


def scatter(groups: dict[tuple[str, str], np.ndarray]) -> np.ndarray:
    """Variance of each component, pooled over the repeats; that of 1X for what was not kept."""
    squares = sum((np.abs(g - g.mean(axis=0)) ** 2).sum(axis=0) for g in groups.values())
    variance = squares / sum(len(g) - 1 for g in groups.values())
    return np.where(variance > 0.0, variance, variance[1])


def judged(before: np.ndarray, after: np.ndarray, variance: np.ndarray, speed_id: str) -> Identification:
    healthy = Calibration(
        rotor=LavalRotor(
            natural_frequency_hz=CRITICAL_RPM / 60.0,
            damping_ratio=DAMPING,
            natural_frequency_tolerance=0.05,
            static_sag_um=0.0,
        ),
        speed_rpm={"N1": 1005.0, "N2": 1206.0}[speed_id],
        revolutions=len(before),
        baseline=before.mean(axis=0),
        variance=variance,
        noise=1e-3,
        noise_variance=0.01,
        samples_per_rev=640.0,
    )
    doubt = variance * (1.0 / len(before) + 1.0 / len(after))
    change = after.mean(axis=0) - healthy.baseline
    return identify(change, doubt, healthy, previous=None, rules=NamingRules())


@pytest.mark.parametrize("plane", [1, 2])
def test_known_changes_of_unbalance_are_unbalance(data: Path, plane: int) -> None:
    """Every condition against every other at its speed; the group may hold what 1X alone cannot exclude."""
    groups = acquisitions(data, plane)
    variance = scatter(groups)
    right, total = 0, 0
    for (speed_id, before), (other, after) in itertools.permutations(groups, 2):
        if speed_id != other:
            continue
        verdict = judged(groups[speed_id, before], groups[speed_id, after], variance, speed_id)
        total += 1
        right += "unbalance" in verdict.group
        assert verdict.verdict not in ("normal", "small_change", "static_load", "rub", "unmodelled")
    assert total == 32
    assert right >= 31


@pytest.mark.parametrize("plane", [1, 2])
def test_repeats_are_no_change(data: Path, plane: int) -> None:
    groups = acquisitions(data, plane)
    variance = scatter(groups)
    for (speed_id, _), vectors in groups.items():
        for i in range(len(vectors) if len(vectors) > 1 else 0):
            verdict = judged(np.delete(vectors, i, axis=0), vectors[i : i + 1], variance, speed_id)
            assert verdict.verdict in ("normal", "small_change")
