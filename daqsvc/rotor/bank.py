"""The bank: observers of all modes side by side, and what they state about the machine.

What it states at the end of a block is stored at once and computed when it is read (`BankReport`).
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from daqsvc.rotor import coupled_kernels, kernels, sweep
from daqsvc.rotor.coupled import couple, coupled_evidence, couplings_at_speed
from daqsvc.rotor.decision import DecisionRules, Declaration, Departure
from daqsvc.rotor.discretise import BankMode, at_speed, discretise, steady_evidence, within
from daqsvc.rotor.observer_batch import FREE, PAPER, BankMemory

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    Floats = NDArray[np.float64]

    Flags = NDArray[np.bool_]


class BankReport:
    """What a bank of M modes states at the end of a block.

    A bank makes one for every block, and few are read whole: it holds a copy of the bank's memory.

    Args:
        declarations: see the attribute.
        rules: thresholds and the rule that declares.
        alike: bool ``[M, M]``, modes that look alike at the present speed.
        memory: the bank's memory, as bytes.

    Attributes:
        declarations: changes of the declared mode within the block, in order.
    """

    __slots__ = ("_alike", "_memory", "_rules", "declarations")

    def __init__(
        self,
        declarations: tuple[Declaration, ...],
        rules: DecisionRules,
        alike: Flags,
        memory: bytes,
    ) -> None:
        self.declarations = declarations
        self._rules = rules
        self._alike = alike
        self._memory = memory

    @property
    def decision(self) -> int:
        """Index of the declared mode, -1 while undetermined."""
        return self._figure("paper_decision" if self._rules.rule == "paper" else "decision")

    @property
    def paper_declarations(self) -> int:
        """Times the paper's rule declared a mode within the block, changed or not."""
        return self._figure("paper_declarations")

    @property
    def probabilities(self) -> Floats:
        """Conditional probabilities of the paper's rule, float64 ``[M]``."""
        log_odds = self._each("log_odds")
        odds = np.exp(log_odds - log_odds.max())
        return np.asarray(odds / odds.sum(), dtype=np.float64)

    @property
    def cusum_nats(self) -> Floats:
        """Evidence of each mode against the decision since its onset, float64 ``[M]``."""
        return self._each("cusum")

    @property
    def lead_nats(self) -> Floats:
        """Evidence of the decision over each mode, float64 ``[M]``.

        It is counted up to one and a half thresholds; infinite for the decision itself.
        """
        lead = self._each("lead")
        if (decision := self._figure("decision")) != UNDETERMINED:
            lead[decision] = math.inf
        return lead

    @property
    def group(self) -> tuple[int, ...]:
        """Indices of the modes that cannot be told apart, the decision among them; empty if it is alone.

        Either the evidence so far does not tell them apart, or their steady orbits are the same at this
        speed.
        """
        decision = self._figure("decision")
        if decision == UNDETERMINED or decision != self.decision:
            return ()
        close = (self._each("lead") < self._rules.group_nats) | self._alike[decision]
        close[decision] = True
        return tuple(np.flatnonzero(close).tolist()) if np.count_nonzero(close) > 1 else ()

    @property
    def departure(self) -> Departure | None:
        """Set while the evidence against the declared mode is past its threshold, but no other mode leads.

        The machine has changed then, and the cause is not yet known.
        """
        departed = self._figure("departed")
        if not departed or (decision := self._figure("decision")) != self.decision:
            return None
        rivals = ~self._alike[decision]
        rivals[decision] = False
        evidence = np.where(rivals, self._each("cusum"), -math.inf)
        leader = int(np.argmax(evidence))
        close = rivals & ((evidence > evidence[leader] - self._rules.group_nats) | self._alike[leader])
        onset = 1 - int(self._each("age")[leader])
        return Departure(1 - departed, onset, tuple(np.flatnonzero(close).tolist()))

    def _figure(self, name: str) -> int:
        return int(BankMemory.of_bytes(self._memory).header[name])

    def _each(self, name: str) -> Floats:
        return BankMemory.of_bytes(self._memory).each(name)


__all__ = ["UNDETERMINED", "BankReport", "ModelBank"]

# A block of a quarter revolution takes three microseconds: looking these up takes a tenth of one.
_contiguous, _FLOAT = np.ascontiguousarray, np.float64

_EXCLUDED_NATS = 1000.0
"""What a mode that is excluded loses with every sample."""
UNDETERMINED = kernels.UNDETERMINED
"""Index of the decision while there is none."""


class ModelBank:
    """Multiple-model fault diagnosis of a rotor (paper, section IV), free-running and paper-faithful at once.

    The result depends on the samples alone, not on how they are cut into blocks.

    Args:
        modes: the hypotheses, healthiest first.
        noise: standard deviation of the measured position, in clearances.
        duration: normalised time between samples, omega_s dt.
        rules: thresholds and the rule that declares.
        variance_factor: see `discretise`.
        decision: index of the mode that is known to be true at the start; -1 to let the evidence decide.

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
        self.couplings = couple(
            self.modes, self.observers, noise=noise, duration=duration, variance_factor=variance_factor
        )
        self.speed = self.modes[0].rotor.w
        speed = abs(self.speed)
        if speed == 0.0:
            raise ValueError("rotor bank: the speed is 0; the bank needs a shaft that turns")
        count = len(self.modes)
        if not UNDETERMINED <= decision < count:
            raise ValueError(f"rotor bank: there is no mode {decision}; the {count} modes count from 0")
        self._duration = duration
        self._excluded = np.zeros(count, dtype=np.bool_)
        self._close = np.zeros((count, count), dtype=np.bool_)
        self._memory = BankMemory.new(self.observers, self.couplings, self.rules.log_priors(names))
        self._memory.set_rules(
            self.rules,
            noise=noise,
            samples_per_rev=max(1, round(2.0 * math.pi / (speed * duration))),
            decision=decision,
        )
        self._compare()
        self.reseed()

    @property
    def decision(self) -> int:
        """Index of the declared mode, -1 while undetermined."""
        return int(self._memory.header["paper_decision" if self.rules.rule == "paper" else "decision"])

    def reseed(self) -> None:
        """Start every observer again, for instance after a long gap; the decision is held.

        The revolution in which they settle is no evidence.
        """
        sweep.start_anew(self._memory.memory)

    def retune(self, speed: float, angle_rad: float) -> None:
        """Follow the shaft to another speed: the reference orbits move, the estimates do not.

        Args:
            speed: normalised shaft speed w, with the sign it was built with.
            angle_rad: shaft angle at the next sample.

        Raises:
            ValueError: the shaft stands still or turns the other way.
        """
        if speed * self.speed <= 0.0 or not math.isfinite(speed):
            raise ValueError(f"rotor bank: normalised speed {speed} is not one of a shaft that keeps turning")
        moved = at_speed(self.observers, self.modes, speed, duration=self._duration)
        couplings = couplings_at_speed(self.couplings, moved, self.modes, speed, duration=self._duration)
        cos, sin = math.cos(angle_rad), math.sin(angle_rad)
        for fields in (FREE, PAPER):
            states = self._memory.states(fields)
            if len(couplings):
                coupled_kernels.change_orbits(
                    self.observers, self.couplings, moved, couplings, cos, sin, states
                )
            else:
                kernels.change_orbits(self.observers, moved, cos, sin, states)
            self._memory.set_states(fields, states)
        self.observers, self.couplings = moved, couplings
        self.speed = speed
        self._put_observers()
        self._compare()

    def look_alike(self, mode: int) -> Flags:
        """Modes that the observers do not tell from this one at the present speed, bool ``[M]``."""
        return np.array(self._look_alike[mode])

    def exclude(self, excluded: Flags, close: Flags) -> None:
        """Take in what else is known of the modes; it holds until it is called again.

        Args:
            excluded: bool ``[M]``, modes that cannot be true; the decision leaves them, also for one that
                looks alike.
            close: bool ``[M, M]``, symmetric, modes that are not to be told apart.
        """
        if (excluded == self._excluded).all() and (close == self._close).all():
            return
        self._excluded, self._close = excluded.copy(), close.copy()
        self._put_observers()
        self._compare()

    def _put_observers(self) -> None:
        couplings = self.couplings
        if self._excluded.any():
            couplings = couplings.copy()
            couplings["log_norm"] += _EXCLUDED_NATS * self._excluded
        self._memory.set_observers(self.observers, couplings)

    def process(self, xy: Floats, cos: Floats, sin: Floats) -> BankReport:
        """Take in a block of samples.

        Args:
            xy: float64 ``[n, 2]``, measured position in clearances. A sample that is NaN, infinite or farther
                out than any disc can be is missing: predicted through, and no evidence. When samples come
                back after more than a revolution, the observers start again.
            cos: float64 ``[n]``, cosine of the shaft angle, from the keyphasor mark. NaN: not known, missing.
            sin: float64 ``[n]``, its sine.

        Returns:
            The bank's report at the end of the block.
        """
        xy, cos, sin = _contiguous(xy, _FLOAT), _contiguous(cos, _FLOAT), _contiguous(sin, _FLOAT)
        declarations: tuple[Declaration, ...] = ()
        memory = self._memory.memory
        end = sweep.advance(xy, cos, sin, 0, memory)
        while end < 0:
            declarations += (self._declaration(-1 - end),)
            end = sweep.advance(xy, cos, sin, -end, memory)
        return BankReport(declarations, self.rules, self._alike, memory.tobytes())

    def _declaration(self, sample: int) -> Declaration:
        """The change of the decision that is in the header."""
        header = self._memory.header
        return Declaration(sample, self.decision, int(header["changed_from"]), int(header["changed_onset"]))

    def _compare(self) -> None:
        """See which modes look alike at the present speed: there is no change between them."""
        if len(self.couplings):
            evidence = coupled_evidence(self.couplings, self.observers, self._duration)
        else:
            evidence = steady_evidence(self.observers, self._duration)
        self._look_alike = within(evidence, self.rules.alike_nats_per_rev)
        separated = np.logical_or.outer(self._excluded, self._excluded)
        self._alike = (self._look_alike & ~separated) | self._close
        self._memory.set_thresholds(np.where(self._alike, math.inf, self.rules.thresholds(len(self.modes))))
