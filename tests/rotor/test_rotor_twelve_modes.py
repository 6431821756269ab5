"""Every fault of the rotor at several levels, told apart by one bank of twelve modes (0 dB, at resonance).

Twenty revolutions healthy, then a fault, dithered; what the bank says thirty revolutions after the onset. The
plant is the simulator's, with the bank's deliberate mismatch in the contact. Modes of the same steady orbit
count as what they are, one group: unbalance x 1.8 and damping 0.1 at resonance.
"""

# ruff: noqa: T201 - the figures are part of what it is for

from __future__ import annotations

import copy
import functools

import numpy as np
import pytest
from support import rotor_runs as runs

from daqsvc.rotor.bank import ModelBank
from daqsvc.rotor.decision import DecisionRules

pytestmark = [pytest.mark.statistical, pytest.mark.timeout(900)]

ONSETS = 8
NOISES = max(1, runs.seeds(120) // ONSETS)
SNR_DB = 0.0
BEFORE_REV, AFTER_REV = 20.5, 30
RULES = DecisionRules(threshold_nats=12.0, identity_nats=5.0, settle_revolutions=4.0)
TWINS = {"U2", "D1"}
BLOCK = runs.PER_REV // 4


class Said:
    """What a bank said about one run: revolutions count from the onset."""

    def __init__(self, bank, names, xy, angle, onset):
        cos, sin = np.cos(angle), np.sin(angle)
        healthy = bank.process(xy[:onset], cos[:onset], sin[:onset])
        self.false = [names[d.mode] for d in healthy.declarations]
        self.named, self.departed, self.candidates = [], None, ()
        for begin in range(onset, onset + AFTER_REV * runs.PER_REV, BLOCK):
            part = slice(begin, begin + BLOCK)
            report = bank.process(xy[part], cos[part], sin[part])
            self.named += [
                ((begin + d.sample - onset) / runs.PER_REV, names[d.mode]) for d in report.declarations
            ]
            if self.departed is None and report.departure is not None:
                self.departed = (begin + BLOCK - 1 + report.departure.sample - onset) / runs.PER_REV
                self.candidates = tuple(names[i] for i in report.departure.candidates)
        self.decision = names[report.decision]
        self.group = {names[i] for i in report.group}
        if self.departed is None and self.named:
            self.departed = self.named[0][0]


@functools.cache
def bank():
    """A bank that is healthy by evidence; building one takes longer than a run."""
    return ModelBank(runs.models(), noise=runs.sigma(SNR_DB), duration=runs.DURATION, rules=RULES, decision=0)


@functools.cache
def row(truth):
    """What the bank said in every run of a truth."""
    names = [mode.name for mode in bank().modes]
    change = runs.TWELVE_PLANTS[truth]
    diagnoses = []
    for i in range(ONSETS):
        changes = [(BEFORE_REV, change)] if change else []
        run = runs.run(changes, BEFORE_REV + AFTER_REV + 1.0, i)
        onset = round((run.begins[0] if change else BEFORE_REV) * runs.PER_REV)
        diagnoses += [
            Said(copy.deepcopy(bank()), names, run.xy(SNR_DB, 1000 * i + j), run.angle, onset)
            for j in range(NOISES)
        ]
    finals = {name: sum(s.decision == name for s in diagnoses) for name in names}
    departed = np.array([np.inf if s.departed is None else s.departed for s in diagnoses])
    print(
        f"{truth:3} {[f'{k} {v}' for k, v in finals.items() if v]}, departure {np.median(departed):.2f} rev"
    )
    return diagnoses


@pytest.mark.parametrize("truth", [name for name in runs.TWELVE_PLANTS if name not in TWINS])
def test_fault_and_level_are_right_after_thirty_revolutions(truth):
    runs_of_truth = row(truth)
    right = sum(s.decision == truth for s in runs_of_truth)
    # At the target's 97 %, 120 runs would have 114 right or more with 95 % confidence.
    assert right >= 0.97 * len(runs_of_truth), [s.decision for s in runs_of_truth if s.decision != truth]
    # A shaft that is 5 % softer differs by one nat a revolution; all else is told apart without a doubt.
    assert truth in {"N", "K1", "K2"} or all(s.group == set() for s in runs_of_truth if s.decision == truth)


@pytest.mark.parametrize("truth", sorted(TWINS))
def test_twins_are_one_group(truth):
    runs_of_truth = row(truth)
    in_group = sum(s.decision in TWINS and s.group == TWINS for s in runs_of_truth)
    assert in_group >= 0.98 * len(runs_of_truth), [(s.decision, s.group) for s in runs_of_truth]
    # Nobody is told that one of the two has turned into the other.
    assert all(
        {a, b} != TWINS for s in runs_of_truth for (_, a), (_, b) in zip(s.named, s.named[1:], strict=False)
    )


def test_departure_is_told_at_once_and_its_name_later():
    for truth in ("U3", "D2", "R", "L3"):
        runs_of_truth = row(truth)
        departed = np.array([s.departed for s in runs_of_truth])
        named = np.array([s.named[0][0] for s in runs_of_truth])
        assert np.median(departed) < 1.5, truth
        assert (named - departed).mean() > 2.0, truth
        assert np.mean([truth in s.candidates or len(s.candidates) > 0 for s in runs_of_truth]) == 1.0


def test_settling_keeps_milder_faults_of_other_kinds_out_of_it():
    def misnamed(settle_revolutions):
        rules = DecisionRules(threshold_nats=12.0, identity_nats=5.0, settle_revolutions=settle_revolutions)
        names = [mode.name for mode in bank().modes]
        wrong = 0
        for i in range(ONSETS):
            run = runs.run([(BEFORE_REV, runs.TWELVE_PLANTS["R"])], BEFORE_REV + AFTER_REV + 1.0, i)
            subject = ModelBank(
                runs.models(), noise=runs.sigma(SNR_DB), duration=runs.DURATION, rules=rules, decision=0
            )
            onset = round(run.begins[0] * runs.PER_REV)
            outcome = Said(subject, names, run.xy(SNR_DB, 1000 * i), run.angle, onset)
            wrong += sum(name != "R" for _, name in outcome.named)
        return wrong

    assert misnamed(0.0) >= ONSETS
    assert misnamed(4.0) == 0


def test_healthy_machine_is_left_alone():
    # 0.3 false declarations in 1000 revolutions: in 14 runs of 12 truths of 20 revolutions, 40,000 in all
    # at 120 runs, 12 are expected; 4 standard deviations fewer are what is allowed here.
    outcomes = [s for truth in runs.TWELVE_PLANTS for s in row(truth)]
    false = [s.false for s in outcomes if s.false]
    revolutions = BEFORE_REV * len(outcomes)
    assert sum(map(len, false)) <= max(1.0, 0.3 * revolutions / 1000.0), false
