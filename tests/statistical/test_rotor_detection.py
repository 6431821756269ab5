"""Does the rotor bank find what happens to the paper's rotor, when, and how often is it wrong?

The plant is the simulator's, with its own integrator, Hertzian contact (alpha 1.5, mu 0.3) and dithered
onsets; the bank has the paper's deliberate mismatch in its rub observer (alpha 1, mu 0.1) and finds
angle and speed from the keyphasor. A wrong declaration is any change to a mode that is not the true one.
"""

from __future__ import annotations

import functools
import itertools

import numpy as np
import pytest
from scipy.stats import binom

from daqsvc.diagnosis.detector import Window
from daqsvc.diagnosis.rotor_bank import KeyphasorProbe, Probe, RotorBankDetector, RotorMode
from daqsvc.rotor.decision import DecisionRules
from daqsvc.rotor.model import RotorParameters
from sim_hw.scenario import load_scenario

pytestmark = pytest.mark.statistical

SEEDS = range(40)
CONFIDENCE = 0.99
ORDER = ["N", "F1", "F1L2", "F1L3"]
# Delays in revolutions, F1, F1L2, F1L3: (not above this in half of all runs, in 95 % of all runs).
TARGETS = {
    0.0: ((2.1, 2.3, 1.6), (3.0, 3.1, 2.0)),
    -5.0: ((3.3, 3.4, 2.2), (4.9, 4.6, 2.5)),
    5.0: ((1.5, 1.6, 1.25), (2.0, 2.2, 1.45)),
}


def diagnose(machine, **rules):
    """Diagnoses of a simulated run, window by window as the pipeline hands them over."""
    detector = RotorBankDetector(
        machine="rig",
        stream="shaft",
        rate_hz=machine.rate_hz,
        speed_rpm=600.0,
        probes=(Probe("x", 0, 0.0), Probe("y", 1, 90.0)),
        keyphasor=KeyphasorProbe("keyphasor", 2, -6.0),
        rotor=RotorParameters(
            natural_frequency_hz=10.0,
            damping_ratio=0.18,
            eccentricity_um=10.0,
            clearance_um=100.0,
            static_sag_um=10.0,
        ),
        modes=(
            RotorMode("N", 0.18),
            RotorMode("F1", 0.10, "alert"),
            RotorMode("F1L2", 0.06, "alert"),
            RotorMode("F1L3", 0.02, "danger", rub=True),
        ),
        noise_um=machine.noise_um,
        rules=DecisionRules(**rules),
    )
    samples = np.column_stack([machine.channels[c] for c in ("x_um", "y_um", "keyphasor_v")])
    period_ns = 1e9 / machine.rate_hz
    said = []
    for begin in range(0, len(samples), 4 * detector.block):
        part = samples[begin : begin + 4 * detector.block].astype(np.float32)
        t_end_ns = round((begin + len(part) - 1) * period_ns)
        said += detector.process(Window(begin, part, t_end_ns, period_ns))
    return said


@functools.cache
def outcomes(snr_db):
    """For each seed: modes in the order declared, and delays of the three faults in revolutions."""
    scenario = load_scenario("paper")
    orders, delays = [], []
    for seed in SEEDS:
        machine = scenario.simulate(seed, snr_db=snr_db)
        changes = [d for d in diagnose(machine) if d.changed]
        orders.append([d.decision for d in changes])
        first = {d.decision: d.end_index / machine.samples_per_rev for d in reversed(changes)}
        delays.append([first.get(o.mode, np.inf) - o.at_rev for o in machine.onsets[1:]])
    return orders, np.array(delays)


def most_allowed(share):
    """Runs out of all that may exceed a quantile which ``share`` of runs exceed, with our confidence."""
    return int(binom.ppf(CONFIDENCE, len(SEEDS), share))


@pytest.mark.parametrize("snr_db", TARGETS)
def test_modes_are_declared_in_order_and_nothing_else(snr_db):
    # 0 wrong in 40 runs of 161 revolutions: less than 0.47 in 1000 revolutions, with 95 % confidence.
    orders, delays = outcomes(snr_db)
    wrong = {seed: order for seed, order in zip(SEEDS, orders, strict=True) if order != ORDER}
    assert wrong == {}
    assert (delays > 0.0).all(), "a fault was declared before it began"


@pytest.mark.parametrize("snr_db", TARGETS)
def test_half_of_all_faults_are_declared_in_time(snr_db):
    _, delays = outcomes(snr_db)
    late = (delays > TARGETS[snr_db][0]).sum(axis=0)
    # If the median were at the target, 99 % of all sets of runs would have no more late ones than this.
    assert (late <= most_allowed(0.5)).all(), np.median(delays, axis=0)


@pytest.mark.parametrize("snr_db", TARGETS)
def test_nearly_all_faults_are_declared_in_time(snr_db):
    _, delays = outcomes(snr_db)
    late = (delays > TARGETS[snr_db][1]).sum(axis=0)
    assert (late <= most_allowed(0.05)).all(), np.sort(delays, axis=0)[-5:]


def test_paper_rule_declares_the_true_mode_most_of_the_time_but_not_always():
    # A reset at 0.9 makes about two declarations a revolution, and up to one in ten of them is wrong by
    # construction: good to look at, useless as an alarm.
    machine = load_scenario("paper").simulate(0, snr_db=0.0)
    said = diagnose(machine, rule="paper")
    declared = np.full(len(machine), -1)
    changes = [d for d in said if d.changed]
    for change in changes:
        declared[change.end_index :] = ORDER.index(change.decision)
    begins = [onset.sample for onset in machine.onsets]
    for mode, (begin, end) in enumerate(itertools.pairwise([*begins, len(machine)])):
        assert (declared[begin:end] == mode).mean() > 0.7, ORDER[mode]
    assert len(changes) > 3 * len(ORDER)
    assert {d.severity for d in said} == {"normal"}
