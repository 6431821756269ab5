"""What a bearing's detector stands by: it takes several looks to raise a fault, and more to take it back."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from daqsvc.detectors.bearing.finding import SOUND

if TYPE_CHECKING:
    from daqsvc.detectors.bearing.finding import BearingFinding

UNDETERMINED = "undetermined"

CONFIRM_LOOKS = 2
"""So many looks in a row must agree before a fault is raised, or called by another name."""
CLEAR_LOOKS = 8
"""So many looks in a row must find nothing before a fault is taken back: damage does not heal."""


@dataclass(frozen=True, slots=True)
class ConfirmedState:
    """What is stood by.

    Attributes:
        decision: the word, or ``"undetermined"`` before anything was found.
        group: what it cannot be told apart from, itself among it; empty if there is nothing.
        where: the bearing that it is about; empty while nothing is stood by.
    """

    decision: str = UNDETERMINED
    group: tuple[str, ...] = ()
    where: str = ""

    @classmethod
    def of(cls, finding: BearingFinding) -> ConfirmedState:
        """What a finding says by itself."""
        group = finding.group if len(finding.group) > 1 else ()
        where = "" if finding.verdict in SOUND else finding.where
        return cls(finding.verdict, group, where)

    @property
    def sound(self) -> bool:
        """Whether nothing is held against the machine."""
        return self.decision in {UNDETERMINED, "normal"}


class PersistenceFilter:
    """Follows findings evaluation by evaluation, without flicker.

    Attributes:
        standing: what is stood by.
    """

    def __init__(self) -> None:
        self.standing = ConfirmedState()
        self._candidate = ConfirmedState()
        self._looks = 0

    def update(self, finding: BearingFinding, *, last: bool = False) -> bool:
        """Take in the finding of one evaluation.

        Args:
            finding: what was found.
            last: whether there will be no other; it counts by itself then, unless something is stood by.

        Returns:
            Whether the standing has changed.
        """
        found = ConfirmedState.of(finding)
        if found == self.standing or (not self.standing.sound and found.decision == "changed"):
            # A part once named is a change, too; that its lines come and go takes nothing back.
            self._looks = 0
            return False
        before = self._candidate
        alike = found.decision == before.decision
        if self.standing.sound and not (found.sound or before.sound):
            alike = True  # two names of a fault are a fault all the same
        self._looks = self._looks + 1 if alike else 1
        self._candidate = found
        at_once = last and self.standing.decision == UNDETERMINED
        if not at_once and self._looks < self._needed(found):
            return False
        self.standing, self._looks = found, 0
        return True

    def interrupt(self) -> None:
        """Looks before a gap do not count with those after it; what is stood by stays."""
        self._looks = 0

    def _needed(self, found: ConfirmedState) -> int:
        if found.sound:
            return 1 if self.standing.decision == UNDETERMINED else CLEAR_LOOKS
        return CONFIRM_LOOKS
