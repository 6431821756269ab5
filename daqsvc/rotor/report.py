"""What a bank says at the end of a block: taken down at once, worked out when somebody asks."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from daqsvc.rotor.decision import Departure
from daqsvc.rotor.kernels import UNDETERMINED
from daqsvc.rotor.observer_batch import BankMemory

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from daqsvc.rotor.decision import DecisionRules, Declaration

    Floats = NDArray[np.float64]
    Flags = NDArray[np.bool_]


class BankReport:
    """What a bank of M modes says at the end of a block.

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
        """Indices of the modes that cannot be told apart, the decision among them; empty if it stands alone.

        Be it that the evidence so far does not tell them, or that their steady orbits are the same at this
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
        decision, departed = self._figure("decision"), self._figure("departed")
        if not departed or decision != self.decision:
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
