"""What a recording reports of a rotor by its bank."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from daqsvc.detectors.rotor_bank.recorded import bank_verdict
from daqsvc.diagnosis.record import Diagnosis
from daqsvc.diagnosis.recorded import Statements
from daqsvc.recording.recording import Recording

RATE_HZ = 640.0
RECORDING = Recording(("x", "y", "k"), np.zeros((6400, 3)), RATE_HZ, Path("one.npz"), 0)
FAULTS = {"N": "normal", "U": "unbalance", "D": "damping_loss"}


def stated(revolution, decision, group=(), **more):
    return Diagnosis(
        machine="pump",
        detector="rotor-bank",
        t_ns=round(revolution * 1e8),
        stream="shaft",
        first_index=64 * (revolution - 2),
        end_index=64 * revolution,
        decision=decision,
        group=group,
        revolutions=float(revolution),
        statistics={"speed": 600.0},
        **more,
    )


def verdict(*diagnoses, closed=False):
    return bank_verdict(RECORDING, Statements("rotor-bank", diagnoses, RATE_HZ), FAULTS, closed=closed)


def test_a_healthy_machine_that_a_fault_looks_like_has_not_changed_yet():
    found = verdict(stated(20, "N", ("N", "D")), stated(60, "U"))
    assert found.verdict == "unbalance"
    assert (found.onset.revolution, found.departure.revolution) == (58, 60)
    healthy = verdict(stated(20, "N", ("N", "D")), stated(60, "N", ("N", "D")))
    assert (healthy.verdict, healthy.onset, healthy.departure) == ("normal", None, None)


def test_what_the_bank_has_no_mode_of_is_a_name():
    found = verdict(
        stated(20, "N"),
        stated(55, "departure", ("U", "D")),
        stated(60, "unmodelled", probabilities={"U": 0.03, "unmodelled": 0.97}),
    )
    assert (found.verdict, found.group, found.named) == ("unmodelled", ("unmodelled",), True)
    assert found.probabilities == {"unbalance": 0.03, "unmodelled": 0.97}
    assert (found.departure.revolution, found.declaration.revolution) == (55, 60)
    beside = verdict(stated(20, "N"), stated(60, "U", ("U", "stiffness_loss")))
    assert (beside.verdict, beside.group) == ("unbalance", ("unbalance", "stiffness_loss"))


def test_a_bank_that_knows_nothing_else_says_so():
    for closed in (True, False):
        found = verdict(stated(20, "N"), stated(60, "U"), closed=closed)
        assert closed == any("knows its modes and nothing else" in one for one in found.quality.problems)
