"""What a bank states of modes that its steady motion does not tell apart."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from daqsvc.detectors.rotor_bank.modes import RotorMode
from daqsvc.detectors.rotor_bank.statements import BankDiagnosisBuilder, Moment
from daqsvc.dsp.quality.probes import RevolutionQuality
from daqsvc.rotor.decision import DecisionRules
from daqsvc.rotor.misfit import Misfit
from daqsvc.rotor.steady_faults import Explanation

FAULTS = ("normal", "unbalance", "unbalance", "damping_loss", "static_load")
BUILDER = BankDiagnosisBuilder(
    machine="pump",
    detector="rotor-bank",
    stream="shaft",
    sensors=("x", "y", "k"),
    modes=tuple(
        RotorMode(name, severity=severity)
        for name, severity in zip("NUVDL", ("normal", "alert", "danger", "alert", "alert"), strict=True)
    ),
    faults=FAULTS,
    others=("stiffness_loss", "rub", "unmodelled"),
    rules=DecisionRules(),
)


def stated(*, decision, lead, together=(), besides=None):
    """What is stated of a bank whose modes are behind the decision by so many nats."""
    report = SimpleNamespace(
        probabilities=np.full(5, 0.2),
        departure=None,
        decision=decision,
        group=tuple(sorted({decision, *together})) if together else (),
        lead_nats=np.array(lead, dtype=np.float64),
        cusum_nats=np.zeros(5),
    )
    pairs = np.zeros((5, 5), dtype=np.bool_)
    pairs[decision, list(together)] = True
    return BUILDER.state(
        report,
        RevolutionQuality(),
        Moment(0, 100, 0, 10.0, 600.0),
        decision=decision,
        stated=besides.others[0] if besides and not besides.faults else "NUVDL"[decision],
        changed=False,
        off=Misfit(np.zeros(5), np.zeros(5, dtype=np.bool_), pairs),
        besides=besides,
        lines=(),
        missing_share=0.0,
    )


def test_faults_that_are_not_told_apart_share_their_probability():
    # The evidence is for the other one by 50 nats: within the model's error that means nothing.
    said = stated(decision=1, lead=[40.0, np.inf, 3.0, -50.0, 60.0], together=[3])
    u, v, d = (said.probabilities[name] for name in "UVD")
    assert u + v == pytest.approx(0.5)
    assert d == pytest.approx(0.5)
    assert v / u == pytest.approx(np.exp(-3.0))
    assert said.probabilities["L"] < 1e-9
    assert sum(said.probabilities.values()) == pytest.approx(1.0)


def test_a_fault_that_is_told_apart_keeps_what_the_evidence_gives_it():
    said = stated(decision=1, lead=[40.0, np.inf, 3.0, 2.0, 60.0])
    assert said.probabilities["D"] / said.probabilities["U"] == pytest.approx(np.exp(-2.0))


def test_what_no_mode_explains_is_as_bad_as_the_nearest_mode_and_has_its_own_evidence():
    besides = Explanation(frozenset(), ("unmodelled",), {"unmodelled": 0.97}, {"unmodelled": 80.0}, 640)
    said = stated(decision=2, lead=[40.0, 3.0, np.inf, 20.0, 60.0], besides=besides)
    assert (said.decision, said.group, said.severity) == ("unmodelled", (), "danger")
    assert said.evidence == {"unmodelled": 80.0}
    assert said.probabilities["rub"] == 0.0
    assert said.probabilities["unmodelled"] == 0.97
    assert sum(said.probabilities.values()) == pytest.approx(1.0)
    assert BUILDER.severity(0, besides) == "alert"


def test_a_mode_that_is_not_told_from_a_fault_without_one_has_it_in_its_group():
    besides = Explanation(frozenset({"unbalance"}), ("damping_loss",), {"damping_loss": 0.4}, {}, 640)
    said = stated(decision=1, lead=[40.0, np.inf, 3.0, 20.0, 60.0], besides=besides)
    assert (said.decision, said.group, said.severity) == ("U", ("U", "damping_loss"), "alert")
    assert said.evidence["lead.N"] == 40.0
    assert sum(said.probabilities.values()) == pytest.approx(1.0)
