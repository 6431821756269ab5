"""The bank's compiled sweep says what both rules say when they are written out plainly, mode by mode."""

from __future__ import annotations

import cmath
import math
from dataclasses import dataclass, field

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support import rotor_runs as runs
from support.examples import examples

from daqsvc.rotor.bank import UNDETERMINED, ModelBank
from daqsvc.rotor.decision import DecisionRules

pytestmark = pytest.mark.property
SETTLING = PER_REV = runs.PER_REV
TWELVE = runs.models()
FOUR = runs.models(runs.PAPER_MODES)
NOISE = runs.sigma(5.0)


@dataclass
class Observer:
    """One observer over complex positions x + iy, as the paper has it: correct, then predict."""

    c: np.void
    healthy: np.void
    d: complex = 0.0
    v: complex = 0.0

    def orbit(self, turn, c=None):
        c = self.c if c is None else c
        u = (c["a"] + 1j * c["b"]) * turn
        return u + c["rest_x"] + 1j * c["rest_y"], 1j * c["speed"] * u

    def take_over(self, estimate, turn):
        at, moving = self.orbit(turn)
        self.d, self.v = estimate[0] - at, estimate[1] - moving

    def estimate(self, turn):
        at, moving = self.orbit(turn)
        return at + self.d, moving + self.v

    def guard(self, turn):
        lost = not abs(self.orbit(turn)[0] + self.d) < 3.0 or not cmath.isfinite(self.v)
        if self.c["substeps"] and lost:
            self.take_over(self.orbit(turn, self.healthy), turn)

    def correct(self, turn, z):
        e = z - self.orbit(turn)[0] - self.d
        self.d += self.c["gain_x"] * e
        self.v += self.c["gain_v"] * e
        return -0.5 * abs(e) ** 2 * self.c["precision"] - self.c["log_norm"]

    def flow(self, prefix=""):
        xx, xv, vx, vv = (self.c[prefix + name] for name in ("xx", "xv", "vx", "vv"))
        self.d, self.v = xx * self.d + xv * self.v, vx * self.d + vv * self.v

    def predict(self, turn):
        if not self.c["substeps"]:
            self.flow()
            return
        step = "half_"
        for _ in range(self.c["substeps"]):
            self.flow(step)
            turn *= self.c[step + "cos"] + 1j * self.c[step + "sin"]
            self.kick(turn)
            step = "full_"
        self.flow("half_")

    def kick(self, turn):
        z, v = self.estimate(turn)
        if abs(z) <= 1.0:
            return
        slip = self.c["surface_speed"] + (z.conjugate() * v).imag / abs(z)
        force = self.c["impulse"] * (abs(z) - 1.0) ** self.c["alpha"] * z / abs(z)
        self.v -= force * (1.0 + 1j * self.c["mu"] * np.sign(slip))


@dataclass
class Bank:
    """Both rules over observers of their own."""

    observers: np.ndarray
    alike: np.ndarray
    rules: DecisionRules
    decision: int
    paper_decision: int = UNDETERMINED
    departed: int = 0
    missing: int = PER_REV + 1
    declared: list = field(default_factory=list)
    paper_declared: list = field(default_factory=list)

    def __post_init__(self):
        self.count = len(self.observers)
        self.lead = np.zeros(self.count)
        self.paper_decision = self.decision
        self.reseed(1.0)

    def reseed(self, turn):
        def new():
            made = [Observer(c, self.observers[0]) for c in self.observers]
            for one in made:
                if one.c["substeps"]:
                    one.take_over(one.orbit(turn, one.healthy), turn)
            return made

        self.free, self.paper = new(), new()
        self.cusum, self.ages = np.zeros(self.count), np.zeros(self.count, dtype=int)
        self.duels = np.zeros((self.count, self.count))
        self.log_p = np.full(self.count, -math.log(self.count))
        self.departed, self.settling = 0, SETTLING

    def take(self, k, z, turn):
        usable = abs(z) ** 2 < (3.0 + 6.0 * NOISE) ** 2
        if usable and self.missing > PER_REV:
            self.reseed(turn)
        self.missing = 0 if usable else self.missing + 1
        scores = np.zeros((2, self.count))
        for row, bank in enumerate((self.free, self.paper)):
            for i, one in enumerate(bank):
                one.guard(turn)
                if usable:
                    scores[row, i] = one.correct(turn, z)
        counts = usable and self.settling == 0
        self.settling = max(0, self.settling - 1)
        self.weigh(k, scores[0] * counts)
        if counts:
            self.believe(k, scores[1], turn)
        for one in (*self.free, *self.paper):
            one.predict(turn)

    def weigh(self, k, score):
        self.ages += 1
        winner, suspect = UNDETERMINED, UNDETERMINED
        if self.decision == UNDETERMINED:
            self.duels = np.maximum(0.0, self.duels + score[:, np.newaxis] - score)
            rivals = ~self.alike & ~np.eye(self.count, dtype=bool)
            narrowest = np.where(rivals, self.duels, np.inf).min(axis=1)
            ahead = np.flatnonzero(narrowest >= self.rules.threshold_nats)
            if len(ahead):
                winner = ahead[np.argmax(self.duels[ahead].sum(axis=1))]
        else:
            self.cusum = np.maximum(0.0, self.cusum + score - score[self.decision])
            self.ages[self.cusum == 0.0] = 0
            self.lead = self.capped(self.lead + score[self.decision] - score)
            suspect, winner = self.verdict()
        self.departed = self.departed + 1 if suspect != UNDETERMINED and winner == UNDETERMINED else 0
        if winner != UNDETERMINED:
            self.declared.append((k, int(winner), self.decision, int(k + 1 - self.ages[winner])))
            if self.decision == UNDETERMINED:
                self.lead = self.capped(self.duels[winner])
            else:
                self.lead = self.capped(self.cusum[winner] - self.cusum)
            self.cusum[:], self.ages[:], self.decision = 0.0, 0, int(winner)

    def capped(self, lead):
        return np.minimum(1.5 * self.rules.threshold_nats, lead)

    def verdict(self):
        evidence = np.where(self.alike[self.decision], -1.0, self.cusum)
        best = int(np.argmax(evidence))
        threshold = self.rules.thresholds(self.count)[self.decision, best]
        if evidence[best] <= 0.0 or evidence[best] < threshold:
            return UNDETERMINED, UNDETERMINED
        others = ~self.alike[best]
        others[best] = False
        second = max(0.0, evidence[others].max())
        settled = self.ages[best] >= round(self.rules.settle_revolutions * PER_REV)
        clear = evidence[best] - second >= self.rules.identity_nats or evidence[best] >= 3.0 * threshold
        return best, best if settled and clear else UNDETERMINED

    def believe(self, k, score, turn):
        self.log_p += score
        self.log_p -= np.logaddexp.reduce(self.log_p)
        best = int(np.argmax(self.log_p))
        if self.log_p[best] <= math.log(self.rules.probability_threshold):
            return
        self.paper_declared.append((k, best))
        estimate = self.paper[best].estimate(turn)
        for one in self.paper:
            one.take_over(estimate, turn)
        self.log_p[:] = -math.log(self.count)


def measured(seed, revolutions, truth):
    """Samples of a healthy machine that turns into another one, with gaps and samples that cannot be."""
    rng = np.random.default_rng(seed)
    n = round(revolutions * PER_REV)
    turn = np.exp(1j * runs.DURATION * (np.arange(n) + rng.uniform(0.0, PER_REV)))
    change = rng.integers(n // 4, n // 2)
    rotors = TWELVE[0].rotor, truth.rotor
    clean = [rotor.orbit() * turn + rotor.rest for rotor in rotors]
    z = np.where(np.arange(n) < change, *clean)
    z *= np.minimum(1.0, 1.2 / np.abs(z))
    z += NOISE * (rng.standard_normal(n) + 1j * rng.standard_normal(n))
    z[rng.random(n) < 0.02] = math.nan
    z[rng.random(n) < 0.01] = 1e3
    gap = rng.integers(0, n)
    z[gap : gap + rng.integers(0, 2 * PER_REV)] = math.nan
    return z, turn


@pytest.mark.long
@settings(max_examples=examples(20), deadline=None, derandomize=True)
@given(
    seed=st.integers(0, 2**32 - 1),
    modes=st.sampled_from([FOUR, TWELVE, TWELVE[:9]]),
    truth=st.sampled_from(TWELVE),
    decision=st.sampled_from([UNDETERMINED, 0, 2]),
    settle=st.sampled_from([0.0, 2.0]),
)
def test_both_rules_say_what_they_say_written_out(seed, modes, truth, decision, settle):
    z, turn = measured(seed, 14, truth)
    rules = DecisionRules(settle_revolutions=settle)
    subjects = {
        rule: ModelBank(
            modes,
            noise=NOISE,
            duration=runs.DURATION,
            rules=DecisionRules(rule=rule, settle_revolutions=settle),
            decision=decision,
        )
        for rule in ("cusum", "paper")
    }
    bank = subjects["cusum"]
    reference = Bank(bank.observers, bank._alike, rules, decision)
    declared = {"cusum": [], "paper": []}
    paper_declarations = 0
    for begin in range(0, len(z), 100):
        part = slice(begin, begin + 100)
        for k in range(begin, min(begin + 100, len(z))):
            reference.take(k, complex(z[k]), complex(turn[k]))
        xy = np.column_stack((z[part].real, z[part].imag))
        reports = {rule: s.process(xy, turn[part].real, turn[part].imag) for rule, s in subjects.items()}
        for rule, report in reports.items():
            declared[rule] += [
                (begin + d.sample, d.mode, d.previous, begin + d.onset) for d in report.declarations
            ]
        report = reports["cusum"]
        paper_declarations += report.paper_declarations
        lead = reference.lead.copy()
        if reference.decision != UNDETERMINED:
            lead[reference.decision] = math.inf
        np.testing.assert_allclose(report.cusum_nats, reference.cusum, atol=1e-8)
        np.testing.assert_allclose(report.lead_nats, lead, atol=1e-8)
        np.testing.assert_allclose(report.probabilities, np.exp(reference.log_p), rtol=1e-8, atol=1e-12)
        assert report.decision == reference.decision
        assert (report.departure is not None) == (reference.departed > 0)
        if report.departure is not None:
            assert report.departure.sample == 1 - reference.departed
    assert declared["cusum"] == reference.declared
    assert paper_declarations == len(reference.paper_declared)
    previous, changes = decision, []
    for k, mode in reference.paper_declared:
        if mode != previous:
            changes.append((k, mode, previous))
        previous = mode
    assert [change[:3] for change in declared["paper"]] == changes


def test_what_is_compared_covers_declarations_departures_and_contact():
    # Else the test above could agree about nothing.
    z, turn = measured(3, 14, TWELVE[9])
    bank = ModelBank(TWELVE, noise=NOISE, duration=runs.DURATION, rules=DecisionRules(settle_revolutions=2.0))
    reports = [
        bank.process(
            np.column_stack((z[k:].real, z[k:].imag))[:1], turn[k : k + 1].real, turn[k : k + 1].imag
        )
        for k in range(len(z))
    ]
    assert sum(len(report.declarations) for report in reports) >= 2
    assert any(report.departure for report in reports)
    assert sum(report.paper_declarations for report in reports) > 10
    assert np.abs(z[np.isfinite(z)]).max() > 1.0
