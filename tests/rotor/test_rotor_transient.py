"""Unbalance or loss of damping? With poles from a run-up, the way from orbit to orbit tells.

Records of an independent finite-element rotor; natural frequency and damping within 2 %, as a run-up gives
them. Eight revolutions after the departure decide.
"""

from __future__ import annotations

import json
import math

import numpy as np
import pytest

from daqsvc.dsp.speed.revolutions import FixedSpeedCutter
from daqsvc.rotor.laval import LavalRotor
from daqsvc.rotor.synchronous.vectors import synchronous_vectors
from daqsvc.rotor.synchronous.watch import RotorWatch

pytestmark = [pytest.mark.statistical, pytest.mark.data]

SEEDS = range(5)


def watched(data, name, snr_db, seed, tolerance):
    """What the watch makes of the first 40 revolutions after the change, in noise."""
    record = np.load(data / "ross" / f"{name}.npz")
    meta = json.loads(str(record["meta"]))
    rng = np.random.default_rng([seed, round(snr_db)])
    xy = np.column_stack((record["x_disc"], record["y_disc"]))[::2] * 1e6
    onset = int(record["onset"][0]) // 2
    sigma = xy[:onset].std(axis=0) / 10.0 ** (snr_db / 20.0)
    xy = (xy + sigma * rng.standard_normal(xy.shape))[: onset + 40 * 64]
    rotor = LavalRotor(
        natural_frequency_hz=meta["omega_s"] / (2.0 * math.pi) * (1.0 + rng.uniform(-1, 1) * tolerance),
        damping_ratio=meta["zeta"] * (1.0 + rng.uniform(-1, 1) * tolerance),
        natural_frequency_tolerance=tolerance,
        damping_tolerance=tolerance,
        clearance_um=meta["clearance"] * 1e6,
    )
    watch = RotorWatch(rotor, float(record["fs"]) / 2.0)
    cut = FixedSpeedCutter(64.0).process(xy)
    watch.evaluate(synchronous_vectors(cut), cut)
    return watch.finish()


@pytest.mark.parametrize("snr_db", [20.0, 10.0])
@pytest.mark.parametrize(
    ("name", "truth"),
    [("A1_damp_L2", "damping_loss"), ("A1_unb_x2_G2p5", "unbalance"), ("A07_unb_x2_G2p5", "unbalance")],
)
def test_an_abrupt_change_is_resolved(data, name, truth, snr_db):
    for seed in SEEDS:
        assert watched(data, name, snr_db, seed, 0.02).group == (truth,)


def test_without_a_run_up_the_group_stays(data):
    for seed in SEEDS:
        assert set(watched(data, "A1_damp_L2", 20.0, seed, 0.2).group) == {"unbalance", "damping_loss"}
