"""From the bearings of a machine, each judged by itself, to one statement about the machine.

A fault is heard at the far bearing, too: the bearing that shows most is the faulty one. That the machine has
changed at all is for the innovations of its healthy model to say, where there is one.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal, get_args

from daqsvc.bearing.race.verdict import PARTS, RaceVerdict, RaceWord

if TYPE_CHECKING:
    from collections.abc import Mapping

    from daqsvc.bearing.identify_change import ResidualChange

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
    verdicts: Mapping[str, RaceVerdict], change: ResidualChange | None, false_alarm_probability: float
) -> BearingFinding:
    """Compare the bearings of a machine.

    Args:
        verdicts: of each bearing that could be judged, by name; at least one.
        change: of the innovations; None without a healthy machine to compare with.
        false_alarm_probability: that ``change`` was judged at.
    """
    faulty = {name: said for name, said in verdicts.items() if said.verdict not in SOUND}
    where = max(faulty or verdicts, key=lambda name: severity_of(verdicts[name]))
    said = verdicts[where]
    if faulty:
        return BearingFinding(
            verdict=said.verdict,
            group=said.group,
            where=where,
            probabilities=_probabilities(said),
            severity=severity_of(said),
        )
    changed = change.changed if change is not None else any(v.verdict == "changed" for v in verdicts.values())
    verdict: RaceWord = "changed" if changed else "normal"
    probabilities = _probabilities(said)
    sound = probabilities["normal"] + probabilities["changed"]
    doubt = false_alarm_probability if changed else 0.0
    probabilities |= {"changed": sound * (1.0 - doubt) if changed else 0.0}
    probabilities |= {"normal": sound - probabilities["changed"]}
    return BearingFinding(
        verdict=verdict,
        group=(verdict,),
        where=where,
        probabilities=probabilities,
        severity=severity_of(said),
    )


def severity_of(said: RaceVerdict) -> float:
    """Of the part that a verdict names; of the one that shows most if it names none."""
    parts = [part for part in PARTS if part in said.group] or PARTS
    return max(said.evidence[part].severity for part in parts)


def _probabilities(said: RaceVerdict) -> dict[RaceWord, float]:
    """Of every word; what cannot be told apart is one word."""
    shares: dict[RaceWord, float] = {word: said.probability.get(word, 0.0) for word in WORDS}
    if said.verdict == "inner_or_outer":
        shares["inner_or_outer"] += shares["inner"] + shares["outer"]
        shares["inner"] = shares["outer"] = 0.0
    return shares
