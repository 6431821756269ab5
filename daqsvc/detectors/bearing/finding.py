"""From the bearings of a machine, each judged by itself, to one statement about the machine.

A fault is heard at the far bearing, too: the bearing that shows most is the faulty one. That the machine has
changed at all is decided by the innovations of its healthy model, where there is one, and by the residual of
two accelerometers, where a bearing has them.

Lines and direction join so. Lines that stand out name a part by themselves. The direction settles which race
if they leave it open, and contradicts them if it is sure of the other race: the verdict is then
``inner_or_outer``. Where no lines stand out the direction names the part that is struck, or leaves it open;
if nothing is struck, for the change is steady, the machine has ``changed``.

It takes several evaluations to confirm a fault, and more to withdraw it.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal, get_args

from daqsvc.bearing.race.verdict import PARTS, RaceVerdict, RaceWord

if TYPE_CHECKING:
    from collections.abc import Mapping

    from daqsvc.bearing.identify import ResidualChange
    from daqsvc.detectors.bearing.direction import Direction


BearingWord = RaceWord

WORDS: tuple[RaceWord, ...] = get_args(RaceWord)
"""All verdicts, healthy first."""

SoundWord = Literal["normal", "changed"]
SOUND: tuple[SoundWord, ...] = get_args(SoundWord)
"""Verdicts that name no part."""


@dataclass(frozen=True, slots=True, kw_only=True)
class BearingFinding:
    """What the bearings of a machine show together.

    Attributes:
        verdict: the word.
        group: parts that the evidence cannot tell apart; the verdict alone where it names no part.
        where: the bearing that the verdict is about; the one that shows most if none is faulty.
        probabilities: of every word, summing to one.
        severity: of the evidence for that part at that bearing, significance times size.
    """

    verdict: RaceWord
    group: tuple[str, ...]
    where: str
    probabilities: Mapping[RaceWord, float] = field(default_factory=dict)
    severity: float = 0.0


def find(
    verdicts: Mapping[str, RaceVerdict],
    change: ResidualChange | None,
    false_alarm_probability: float,
    directions: Mapping[str, Direction] | None = None,
) -> BearingFinding:
    """Compare the bearings of a machine.

    Args:
        verdicts: of each bearing that could be judged, by name; at least one.
        change: of the innovations; None without a healthy machine to compare with.
        false_alarm_probability: that ``change`` was judged at.
        directions: what the two accelerometers of a bearing show, of those that have two.
    """
    directions = directions or {}
    deciding = {name: one for name, one in directions.items() if one.decides}
    faulty = {name: race for name, race in verdicts.items() if race.verdict not in SOUND}
    felt = {name: one for name, one in directions.items() if one.detected}
    if not faulty and (felt or deciding):
        among = {name: deciding[name] for name in felt if name in deciding} or felt or deciding
        where = max(among, key=lambda name: among[name].change_nats / among[name].limit_nats)
    else:
        where = max(faulty or verdicts, key=lambda name: severity_of(verdicts[name]))
    race = verdicts[where]
    shares = _probabilities(race)
    verdict: RaceWord = race.verdict
    group = race.group
    if faulty:
        if where in deciding:
            verdict, group = _corroborated(race, deciding[where])
    else:
        changed = any(v.verdict == "changed" for v in verdicts.values()) if change is None else change.changed
        verdict = "changed" if changed or felt else "normal"
        group = (verdict,)
        if verdict == "changed" and where in directions and directions[where].group:
            group = directions[where].group
            verdict = group[0] if directions[where].decides else "inner_or_outer"
        doubt = 0.0 if verdict == "normal" else false_alarm_probability
        sound = shares["normal"] + shares["changed"]
        shares |= {"normal": sound * doubt, "changed": 0.0}
        shares[verdict] += sound * (1.0 - doubt)
    if verdict == "inner_or_outer":
        # What cannot be told apart is one word.
        shares |= {"inner_or_outer": shares["inner_or_outer"] + shares["inner"] + shares["outer"]}
        shares |= {"inner": 0.0, "outer": 0.0}
    elif verdict != race.verdict and race.verdict == "inner_or_outer":
        shares |= {verdict: shares["inner"] + shares["outer"], _OTHER[verdict]: 0.0}
    return BearingFinding(
        verdict=verdict, group=group, where=where, probabilities=shares, severity=severity_of(race)
    )


_OTHER: Mapping[RaceWord, RaceWord] = {"inner": "outer", "outer": "inner"}


def _corroborated(verdict: RaceVerdict, direction: Direction) -> tuple[RaceWord, tuple[str, ...]]:
    """A verdict by lines, with what the direction shows about the races: it settles a doubt or raises one."""
    race = direction.group[0]
    if len(direction.group) == 1 and race in _OTHER:
        if verdict.verdict == "inner_or_outer":
            return race, (race,)
        if race == _OTHER.get(verdict.verdict):
            return "inner_or_outer", (verdict.verdict, race)
    return verdict.verdict, verdict.group


def severity_of(verdict: RaceVerdict) -> float:
    """Of the part that a verdict names; of the one that shows most if it names none."""
    parts = [part for part in PARTS if part in verdict.group] or PARTS
    return max(verdict.evidence[part].severity for part in parts)


def _probabilities(verdict: RaceVerdict) -> dict[RaceWord, float]:
    """Of every word."""
    return {word: verdict.probability.get(word, 0.0) for word in WORDS}


UNDETERMINED = "undetermined"

CONFIRM_LOOKS = 2
"""Evaluations in a row that must agree before a fault is raised, or gets another name."""
CLEAR_LOOKS = 8
"""Evaluations in a row that must find nothing before a fault is withdrawn: damage does not heal."""


@dataclass(frozen=True, slots=True)
class ConfirmedState:
    """The confirmed state.

    Attributes:
        decision: the word, or ``"undetermined"`` before anything was found.
        group: what it cannot be told apart from, itself among it; empty if there is nothing.
        where: the bearing that it is about; empty while nothing is confirmed.
    """

    decision: str = UNDETERMINED
    group: tuple[str, ...] = ()
    where: str = ""

    @classmethod
    def of(cls, finding: BearingFinding) -> ConfirmedState:
        """What a finding states by itself."""
        group = finding.group if len(finding.group) > 1 else ()
        where = "" if finding.verdict in SOUND else finding.where
        return cls(finding.verdict, group, where)

    @property
    def sound(self) -> bool:
        """Whether nothing is compared with the machine."""
        return self.decision in {UNDETERMINED, "normal"}


class PersistenceFilter:
    """Follows findings evaluation by evaluation, without flicker.

    Attributes:
        standing: the confirmed state.
    """

    def __init__(self) -> None:
        self.standing = ConfirmedState()
        self._candidate = ConfirmedState()
        self._looks = 0

    def update(self, finding: BearingFinding, *, last: bool = False) -> bool:
        """Take in the finding of one evaluation.

        Args:
            finding: what was found.
            last: whether there will be no other; it counts by itself then, unless something is confirmed.

        Returns:
            Whether the standing has changed.
        """
        state = ConfirmedState.of(finding)
        if state == self.standing or (not self.standing.sound and state.decision == "changed"):
            # A part once named is a change, too; that its lines come and go takes nothing back.
            self._looks = 0
            return False
        before = self._candidate
        alike = state.decision == before.decision
        if self.standing.sound and not (state.sound or before.sound):
            alike = True  # two names of a fault are a fault all the same
        self._looks = self._looks + 1 if alike else 1
        self._candidate = state
        at_once = last and self.standing.decision == UNDETERMINED
        if not at_once and self._looks < self._needed(state):
            return False
        self.standing, self._looks = state, 0
        return True

    def interrupt(self) -> None:
        """Evaluations before a gap do not count with those after it; the confirmed state stays."""
        self._looks = 0

    def _needed(self, state: ConfirmedState) -> int:
        if state.sound:
            return 1 if self.standing.decision == UNDETERMINED else CLEAR_LOOKS
        return CONFIRM_LOOKS
