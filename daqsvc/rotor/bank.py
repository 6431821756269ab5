"""The bank: observers of all modes side by side, and what they say about the machine."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from daqsvc.rotor import kernels
from daqsvc.rotor.cusum import decide_by_cusum
from daqsvc.rotor.decision import DecisionRules, Declaration, Departure
from daqsvc.rotor.discretise import BankMode, at_speed, discretise
from daqsvc.rotor.likeness import alike

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from numpy.typing import NDArray

    Floats = NDArray[np.float64]
    Flags = NDArray[np.bool_]
    Ints = NDArray[np.int64]

UNDETERMINED = kernels.UNDETERMINED
"""Index of the decision while there is none."""

_LEAD_LIMIT = 1.5
"""The lead of the decision counts up to this many thresholds, so that a doubt shows before it wins."""


@dataclass(frozen=True, slots=True)
class BankReport:
    """What a bank of M modes says at the end of a block.

    Attributes:
        decision: index of the declared mode, -1 while undetermined.
        declarations: changes of the declared mode within the block, in order.
        paper_declarations: times the paper's rule declared a mode within the block, changed or not.
        probabilities: float64 ``[M]``, conditional probabilities of the paper's rule.
        cusum_nats: float64 ``[M]``, evidence of each mode against the decision since its onset.
        lead_nats: float64 ``[M]``, evidence of the decision over each mode, counted up to one and a half
            thresholds; infinite for the decision itself.
        group: indices of the modes that cannot be told apart, the decision among them, be it that the
            evidence so far does not or that their steady orbits are the same at this speed; empty if the
            decision stands alone.
        departure: set while the evidence against the declared mode is past its threshold, but no other
            mode leads the rest by the margin: the machine has changed, the cause is not yet known.
    """

    decision: int
    declarations: tuple[Declaration, ...]
    paper_declarations: int
    probabilities: Floats
    cusum_nats: Floats
    lead_nats: Floats
    group: tuple[int, ...]
    departure: Departure | None = None


class ModelBank:
    """Multiple-model fault diagnosis of a rotor (paper, section IV), free-running and paper-faithful at once.

    The result depends on the samples alone, not on how they are cut into blocks.

    Args:
        modes: the hypotheses, healthiest first.
        noise: standard deviation of the measured position, in clearances.
        duration: normalised time between samples, omega_s dt.
        rules: thresholds and the rule that declares.
        variance_factor: see `discretise`.
        decision: index of the mode that is known to be true at the start; -1 to let the evidence tell.

    Raises:
        ValueError: the modes or figures cannot make a bank.
    """

    def __init__(
        self,
        modes: Sequence[BankMode],
        *,
        noise: float,
        duration: float,
        rules: DecisionRules | None = None,
        variance_factor: float = 1.0,
        decision: int = UNDETERMINED,
    ) -> None:
        names = [mode.name for mode in modes]
        if len(set(names)) != len(names) or len(names) < 2:
            raise ValueError(f"rotor bank: modes {names} must be two or more with different names")
        self.modes = tuple(modes)
        self.rules = rules or DecisionRules()
        self.observers = discretise(
            self.modes, noise=noise, duration=duration, variance_factor=variance_factor
        )
        self.speed = self.modes[0].rotor.w
        speed = abs(self.speed)
        if speed == 0.0:
            raise ValueError("rotor bank: the speed is 0; the bank needs a shaft that turns")
        count = len(self.modes)
        self._duration = duration
        self._usable_squared = (kernels.ESCAPE_RADIUS + 6.0 * noise) ** 2
        self._samples_per_rev = max(1, round(2.0 * math.pi / (speed * duration)))
        self._log_prior = self.rules.log_priors(names)
        self._thresholds = self.rules.thresholds(count)
        self._alike = alike(self.observers, duration, self.rules.alike_nats_per_rev)
        self._states = np.zeros((count, 4))
        self._paper_states = np.zeros((count, 4))
        self._log_probability = self._log_prior.copy()
        self._cusum = np.zeros(count)
        self._lead = np.zeros(count)
        self._duels = np.zeros((count, count))
        self._ages = np.zeros(count, dtype=np.int64)
        if not UNDETERMINED <= decision < count:
            raise ValueError(f"rotor bank: there is no mode {decision}; the {count} modes count from 0")
        self._cusum_decision = decision
        self._cusum_previous = decision
        self._paper_decision = decision
        self._departed = 0
        self._paper_age = 0
        self._unusable = 0
        self._settling = 0
        self.reseed()

    @property
    def decision(self) -> int:
        """Index of the declared mode, -1 while undetermined."""
        return self._paper_decision if self.rules.rule == "paper" else self._cusum_decision

    def reseed(self) -> None:
        """Start every observer anew, for instance after a long gap; the decision is held.

        Linear observers start on their own orbits, rub observers on the healthy one. The revolution that
        they need to find the machine is no evidence.
        """
        # NaN means lost: the guard in the kernel puts a rub observer onto the healthy orbit at once.
        lost = np.where(self.observers["substeps"][:, np.newaxis] > 0, np.nan, 0.0)
        self._states[:] = lost
        self._paper_states[:] = lost
        self._log_probability[:] = self._log_prior
        self._cusum[:] = 0.0
        self._duels[:] = 0.0
        self._ages[:] = 0
        self._departed = 0
        self._paper_age = 0
        self._unusable = self._samples_per_rev + 1
        self._settling = self._samples_per_rev

    def retune(self, speed: float, angle_rad: float) -> None:
        """Follow the shaft to another speed: the reference orbits move, the estimates do not.

        Args:
            speed: normalised shaft speed w, with the sign it was built with.
            angle_rad: shaft angle at the next sample.

        Raises:
            ValueError: the shaft stands or turns the other way.
        """
        if speed * self.speed <= 0.0 or not math.isfinite(speed):
            raise ValueError(f"rotor bank: normalised speed {speed} is not one of a shaft that keeps turning")
        moved = at_speed(self.observers, self.modes, speed, duration=self._duration)
        for states in (self._states, self._paper_states):
            kernels.change_orbits(self.observers, moved, math.cos(angle_rad), math.sin(angle_rad), states)
        self.observers = moved
        self.speed = speed
        self._alike = alike(moved, self._duration, self.rules.alike_nats_per_rev)

    def process(self, xy: Floats, cos: Floats, sin: Floats) -> BankReport:
        """Take in a block of samples.

        Args:
            xy: float64 ``[n, 2]``, measured position in clearances. A sample that is NaN, infinite or farther
                out than any disc can be is missing: predicted through, and no evidence.
            cos: float64 ``[n]``, cosine of the shaft angle, from the keyphasor mark. NaN: not known, missing.
            sin: float64 ``[n]``, its sine.

        Returns:
            The bank's report at the end of the block.
        """
        xy, cos, sin = (np.ascontiguousarray(array, dtype=np.float64) for array in (xy, cos, sin))
        with np.errstate(invalid="ignore", over="ignore"):
            usable = (xy[:, 0] ** 2 + xy[:, 1] ** 2 < self._usable_squared) & np.isfinite(cos + sin)
        declarations: list[Declaration] = []
        paper_declarations = 0
        for first, end in self._stretches(usable):
            part = slice(first, end)
            changes, paper = self._run(xy[part], usable[part], cos[part], sin[part])
            declarations += [replace(c, sample=c.sample + first, onset=c.onset + first) for c in changes]
            paper_declarations += paper
        return self._report(tuple(declarations), paper_declarations)

    def _stretches(self, usable: Flags) -> Iterator[tuple[int, int]]:
        """Cut a block where samples begin, or come back after more than a revolution; start anew there."""
        if not self._unusable and usable.all():
            yield 0, len(usable)
            return
        first = 0
        present = np.flatnonzero(usable)
        gaps = np.diff(present, prepend=-1 - self._unusable) - 1
        for start in present[gaps > self._samples_per_rev].tolist():
            if start > first:
                yield first, start
            self.reseed()
            first = start
        self._unusable = len(usable) - 1 - int(present[-1]) if len(present) else self._unusable + len(usable)
        if len(usable) > first:
            yield first, len(usable)

    def _run(self, xy: Floats, usable: Flags, cos: Floats, sin: Floats) -> tuple[list[Declaration], int]:
        """Both rules over a stretch: the declared rule's changes, and how often the paper's rule declared."""
        n = len(xy)
        settling = min(self._settling, n)
        self._settling -= settling
        paper_verdicts = np.empty(n, dtype=np.int64)
        kernels.decide_by_probability(
            xy, usable, cos, sin, self.observers, settling,
            self._log_prior, math.log(self.rules.probability_threshold),
            self._paper_states, self._log_probability, paper_verdicts,
        )  # fmt: skip
        scores = np.empty((len(self.modes), n))
        kernels.run_free(xy, usable, cos, sin, self.observers, self._states, scores)
        scores[:, :settling] = 0.0
        cusum_verdicts = np.empty(n, dtype=np.int64)
        suspects = np.empty(n, dtype=np.int64)
        ages = np.zeros(n, dtype=np.int64)
        self._cusum_decision = decide_by_cusum(
            scores, self._thresholds, self.rules.threshold_nats, self.rules.identity_nats,
            round(self.rules.settle_revolutions * self._samples_per_rev),
            _LEAD_LIMIT * self.rules.threshold_nats, self._alike, self._cusum_decision,
            self._cusum, self._lead, self._duels, self._ages, cusum_verdicts, suspects, ages,
        )  # fmt: skip
        known = np.flatnonzero(suspects == UNDETERMINED)
        self._departed = n - 1 - int(known[-1]) if len(known) else self._departed + n
        paper_changes = self._paper_changes(paper_verdicts)
        paper_declarations = int(np.count_nonzero(paper_verdicts != UNDETERMINED))
        if self.rules.rule == "paper":
            return paper_changes, paper_declarations
        return self._cusum_changes(cusum_verdicts, ages), paper_declarations

    def _cusum_changes(self, verdicts: Ints, ages: Ints) -> list[Declaration]:
        """Changes of the CUSUM's decision; every verdict of it is one."""
        changes = []
        for sample in np.flatnonzero(verdicts != UNDETERMINED).tolist():
            mode = int(verdicts[sample])
            changes.append(Declaration(sample, mode, self._cusum_previous, sample + 1 - int(ages[sample])))
            self._cusum_previous = mode
        return changes

    def _paper_changes(self, verdicts: Ints) -> list[Declaration]:
        """Changes of the mode that the paper's rule declares; it mostly declares the same one again."""
        changes = []
        onset = -self._paper_age
        for sample in np.flatnonzero(verdicts != UNDETERMINED).tolist():
            mode = int(verdicts[sample])
            if mode != self._paper_decision:
                changes.append(Declaration(sample, mode, self._paper_decision, onset))
                self._paper_decision = mode
            onset = sample + 1
        self._paper_age = len(verdicts) - onset
        return changes

    def _report(self, declarations: tuple[Declaration, ...], paper_declarations: int) -> BankReport:
        lead = self._lead.copy()
        group: tuple[int, ...] = ()
        departure = None
        decision = self._cusum_decision
        if decision != UNDETERMINED and decision == self.decision:
            close = (lead < self.rules.group_nats) | self._alike[decision]
            close[decision] = True
            if np.count_nonzero(close) > 1:
                group = tuple(np.flatnonzero(close).tolist())
            if self._departed:
                departure = self._departure(decision)
        if decision != UNDETERMINED:
            lead[decision] = math.inf
        probabilities = np.exp(self._log_probability)
        return BankReport(
            decision=self.decision,
            declarations=declarations,
            paper_declarations=paper_declarations,
            probabilities=probabilities / probabilities.sum(),
            cusum_nats=self._cusum.copy(),
            lead_nats=lead,
            group=group,
            departure=departure,
        )

    def _departure(self, decision: int) -> Departure:
        """The departure that the present block ends in."""
        rivals = ~self._alike[decision]
        rivals[decision] = False
        evidence = np.where(rivals, self._cusum, -math.inf)
        leader = int(np.argmax(evidence))
        close = rivals & ((evidence > evidence[leader] - self.rules.group_nats) | self._alike[leader])
        onset = 1 - int(self._ages[leader])
        return Departure(1 - self._departed, onset, tuple(np.flatnonzero(close).tolist()))
