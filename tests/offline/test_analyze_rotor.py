"""The development table of finite-element rotors, through `analyse` as ``daqsvc analyze`` calls it.

Twelve recordings of two rotors (ROSS, an independent finite-element code), 64 samples a revolution, white
noise at 20, 10 and 0 dB, 20 seeds each; the first 50 revolutions calibrate; natural frequency and damping are
off by up to 20 % at random. Seeds are fixed: 720 runs, the same every time, and 120 more of a rotor known to
2 %; half of both in .ci/run.
"""

from __future__ import annotations

import json
import math
import multiprocessing
import os
from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from support.made_once import made_once

from daqsvc.detectors.rotor_synchronous.recorded import analyse
from daqsvc.detectors.rotor_synchronous.recorded_speed import RotorSetup
from daqsvc.recording.recording import Recording
from daqsvc.rotor.laval import LavalRotor

pytestmark = [pytest.mark.data, pytest.mark.statistical, pytest.mark.timeout(1800)]

SEEDS = 20
HALF_OR_ALL = [SEEDS // 2, pytest.param(SEEDS, marks=pytest.mark.marathon)]
SNRS_DB = (20, 10, 0)
CALIBRATE = 50
TOLERANCE = 0.2
KNOWN = 0.02
"""Tolerance of a rotor that a run-up was fitted to."""
UNBALANCE_OR_DAMPING = {"unbalance", "damping_loss"}
TRUTHS = {
    "A07_healthy_G2p5": "normal",
    "A07_unb_x2_G2p5": "unbalance",
    "A1_damp_L2": "damping_loss",
    "A1_healthy_G2p5": "normal",
    "A1_healthy_e0p1": "normal",
    "A1_misalign": "unmodelled",
    "A1_rub_1": "rub",
    "A1_static_l0p1": "static_load",
    "A1_stiff_k0p75": "stiffness_loss",
    "A1_unb_x2_G2p5": "unbalance",
    "B_healthy_G6p3": "normal",
    "B_unb_x2": "unbalance",
}
FAULTS = {name: truth for name, truth in TRUTHS.items() if truth != "normal"}


@dataclass(frozen=True)
class Run:
    """A noisy recording: false alarms before the onset, delay of the alarm after it, what was said when."""

    file: str
    snr_db: int
    false_alarms: int
    healthy_revolutions: int
    delay: float
    said: dict[int, str]


def judged(truth: str, group: tuple[str, ...], *, named: bool) -> str:
    """``ok``, ``unsettled``, ``group`` (the truth in it), ``wrong``."""
    if not group or not named:
        return "unsettled"
    right = truth in group and (len(group) == 1 or set(group) <= UNBALANCE_OR_DAMPING)
    if truth == "unmodelled":
        right = set(group) in ({"unmodelled"}, {"small_change"})
    if right:
        return "ok"
    return "group" if truth in group else "wrong"


def noisy(
    path: Path, snr_db: int, seed: int, tolerance: float = TOLERANCE
) -> tuple[Recording, RotorSetup, int]:
    """A recording at 64 samples a revolution with noise, what its user knows, the onset in revolutions."""
    with np.load(path) as file:
        clean = 1e6 * np.column_stack([file["x_disc"], file["y_disc"]]).astype(np.float64)[::2]
        per_revolution, rate_hz = int(file["spr"]) // 2, float(file["fs"]) / 2
        onset = int(file["onset"][0]) // 2 if len(file["onset"]) else len(clean)
        meta = json.loads(str(file["meta"]))
    rng = np.random.default_rng([seed, snr_db, *path.stem.encode()])
    deviation = np.sqrt(clean[:onset].var(axis=0) / 10 ** (snr_db / 10))
    samples = clean + deviation * rng.standard_normal(clean.shape)
    off = 1.0 + tolerance * rng.uniform(-1.0, 1.0, 2)
    # Rotor B is no Laval rotor: its users have these figures from its makers.
    rotor = LavalRotor(
        natural_frequency_hz=off[0] * meta.get("omega_s", 485.0) / (2.0 * math.pi),
        damping_ratio=off[1] * meta.get("zeta", 0.064),
        natural_frequency_tolerance=tolerance,
        damping_tolerance=tolerance,
        clearance_um=meta.get("clearance", 0.01) * 1e6,
    )
    recording = Recording(("x", "y"), samples, rate_hz, path, nan_count=0)
    return (
        recording,
        RotorSetup(probes=("x", "y"), rotor=rotor, speed_rpm=meta["rpm"]),
        onset // per_revolution,
    )


def run(job: tuple[str, int, int]) -> Run:
    path, snr_db, seed = job
    recording, setup, onset = noisy(Path(path), snr_db, seed)
    analysis = analyse(recording, setup)
    assert analysis.refused is None, f"{path} at {snr_db} dB, seed {seed}: {analysis.refused}"
    truth = TRUTHS[Path(path).stem]
    departures = [step.revolution for step in analysis.history if step.verdict is None]
    # What stands when so many revolutions have passed since the onset.
    said = {}
    for revolutions in (20, 50, 120, 220):
        before = [step for step in analysis.history if onset < step.revolution <= onset + revolutions]
        last = before[-1] if before else None
        said[revolutions] = "silent" if last is None else judged(truth, last.group, named=last.named)
    if truth != "normal":
        said[220] = judged(truth, analysis.group, named=analysis.named)
    after = [revolution - onset for revolution in departures if revolution > onset]
    return Run(
        Path(path).stem,
        snr_db,
        sum(revolution <= onset for revolution in departures),
        onset - CALIBRATE,
        after[0] if after else math.inf,
        said,
    )


def resolved(job: tuple[str, int, int]) -> bool:
    """Whether 20 revolutions after the onset unbalance and loss of damping are told apart, and rightly."""
    path, snr_db, seed = job
    recording, setup, onset = noisy(Path(path), snr_db, seed, KNOWN)
    analysis = analyse(recording, setup)
    looks = [step for step in analysis.history if onset < step.revolution <= onset + 20]
    return looks[-1].named and looks[-1].group == (TRUTHS[Path(path).stem],)


@cache
def table(directory: Path, seeds: int) -> tuple[Run, ...]:
    jobs = [
        (str(directory / f"{name}.npz"), snr_db, seed)
        for name in TRUTHS
        for snr_db in SNRS_DB
        for seed in range(seeds)
    ]
    with processes() as pool:
        return tuple(pool.map(run, jobs, chunksize=20))


def processes() -> ProcessPoolExecutor:
    return ProcessPoolExecutor(min(2, os.cpu_count() or 1), multiprocessing.get_context("spawn"))


@pytest.fixture(scope="module", params=HALF_OR_ALL)
def runs(
    data: Path, tmp_path_factory: pytest.TempPathFactory, request: pytest.FixtureRequest
) -> tuple[Run, ...]:
    seeds = request.param
    return made_once(tmp_path_factory, f"rotors-{seeds}-seeds", lambda _: table(data / "ross", seeds))


def of(runs: tuple[Run, ...], snr_db: int, name: str) -> list[Run]:
    return [run for run in runs if run.snr_db == snr_db and run.file == name]


def within(these: list[Run], revolutions: float) -> bool:
    """Whether 95 % of the alarms come within so many revolutions."""
    return sum(run.delay <= revolutions for run in these) >= 0.95 * len(these)


@pytest.mark.parametrize("snr_db", SNRS_DB)
def test_false_alarms_are_as_rare_as_promised(runs: tuple[Run, ...], snr_db: int) -> None:
    healthy = [run for run in runs if run.snr_db == snr_db]
    alarms, revolutions = (
        sum(run.false_alarms for run in healthy),
        sum(run.healthy_revolutions for run in healthy),
    )
    seeds = len(healthy) // len(TRUTHS)
    assert revolutions > 750 * seeds
    # 0.5 per 1000 revolutions; expected are 0.1: of all seeds a count of 9 in 17,600 would be chance once in
    # 10,000 tries.
    assert alarms <= 0.5 * revolutions / 1000


@pytest.mark.parametrize("name", FAULTS)
def test_at_20_db(runs: tuple[Run, ...], name: str) -> None:
    these = of(runs, 20, name)
    assert within(these, 2)
    told = Counter(run.said[20] for run in these)
    assert told["ok"] >= int(0.95 * len(these))
    assert told["wrong"] == 0


@pytest.mark.parametrize("name", FAULTS)
def test_at_10_db(runs: tuple[Run, ...], name: str) -> None:
    these = of(runs, 10, name)
    misaligned = name == "A1_misalign"
    assert within(these, 20 if misaligned else 3)
    told = Counter(run.said[120 if misaligned else 50] for run in these)
    assert told["ok"] >= int((0.90 if misaligned else 0.95) * len(these))
    assert told["wrong"] <= 0.01 * len(these)


@pytest.mark.parametrize("name", [name for name in FAULTS if name != "A1_misalign"])
def test_at_0_db(runs: tuple[Run, ...], name: str) -> None:
    these = of(runs, 0, name)
    limit = {"stiffness_loss": 10, "rub": 40}.get(FAULTS[name], 5)
    assert within(these, limit)
    told = Counter(run.said[220] for run in these)
    assert told["ok"] >= int(0.85 * len(these))
    assert told["wrong"] <= 0.02 * len(these)


@pytest.mark.parametrize("seeds", HALF_OR_ALL)
@pytest.mark.parametrize("snr_db", [20, 10])
def test_a_rotor_that_is_known_from_a_run_up_tells_unbalance_from_damping(
    data: Path, snr_db: int, seeds: int
) -> None:
    names = ("A1_damp_L2", "A1_unb_x2_G2p5", "A07_unb_x2_G2p5")
    jobs = [(str(data / "ross" / f"{name}.npz"), snr_db, seed) for name in names for seed in range(seeds)]
    with processes() as pool:
        right = list(pool.map(resolved, jobs, chunksize=10))
    assert sum(right) >= 0.95 * len(right)
