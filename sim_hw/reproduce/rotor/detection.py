"""What the bank declares under either rule, and how soon and how rightly."""

from __future__ import annotations

import copy
import itertools
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from daqsvc.rotor.bank import ModelBank
from daqsvc.rotor.decision import DecisionRules, Rule
from sim_hw.reproduce.rotor.setup import MODES, SAMPLE, SAMPLES_PER_REV, hypotheses

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    Floats = NDArray[np.float64]
    Ints = NDArray[np.int64]

RULES: tuple[Rule, ...] = ("paper", "cusum")
_EXCUSED_REV = 3.0
"""For this long after a change the mode before it is not wrong yet."""


@dataclass(frozen=True, slots=True)
class DetectionTrace:
    """The paper's rule, sample by sample.

    Attributes:
        probabilities: float64 ``[n, M]``, conditional probabilities; at a declaration those after the reset.
        declared: int64 ``[n]``, index of the mode declared at the sample, -1 where there was none.
    """

    probabilities: Floats
    declared: Ints


@dataclass(frozen=True, slots=True)
class DetectionRun:
    """One run of the bank over the whole schedule.

    Attributes:
        changes: declared modes in order, as (sample, index of the mode).
        paper_declarations: how often the paper's rule declared a mode, changed or not.
    """

    changes: tuple[tuple[int, int], ...]
    paper_declarations: int


def new_bank(rule: Rule, noise: float) -> ModelBank:
    """The bank of the four modes.

    Args:
        rule: the rule whose mode counts as declared.
        noise: standard deviation of the measured position in clearances.
    """
    return ModelBank(hypotheses(rule), noise=noise, duration=SAMPLE, rules=DecisionRules(rule=rule))


def trace(xy: Floats, angle_rad: Floats, noise: float) -> DetectionTrace:
    """Follow the paper's rule through a measurement, sample by sample.

    Args:
        xy: float64 ``[n, 2]``, measured position in clearances.
        angle_rad: float64 ``[n]``, shaft angle.
        noise: standard deviation of the measured position.
    """
    bank = new_bank("paper", noise)
    cos, sin = np.cos(angle_rad), np.sin(angle_rad)
    probabilities = np.empty((len(xy), len(MODES)))
    declared = np.full(len(xy), -1, dtype=np.int64)
    for k in range(len(xy)):
        now = slice(k, k + 1)
        report = bank.process(xy[now], cos[now], sin[now])
        probabilities[k] = report.probabilities
        if report.paper_declarations:
            declared[k] = report.decision
    return DetectionTrace(probabilities, declared)


def run(bank: ModelBank, xy: Floats, angle_rad: Floats) -> DetectionRun:
    """A bank over a whole measurement at once.

    Args:
        bank: as `new_bank` made it; it stays new.
        xy: float64 ``[n, 2]``, measured position in clearances.
        angle_rad: float64 ``[n]``, shaft angle.
    """
    report = copy.deepcopy(bank).process(xy, np.cos(angle_rad), np.sin(angle_rad))
    changes = tuple((change.sample, change.mode) for change in report.declarations)
    return DetectionRun(changes, report.paper_declarations)


def delays_rev(changes: Sequence[tuple[int, int]], begins_rev: Sequence[float], end_rev: float) -> Floats:
    """Revolutions from each onset to the first declaration of that mode, before the next onset.

    A mode that was declared already, wrongly, when it began has a delay of 0; one that was not
    declared before the next began has an infinite one.

    Args:
        changes: as in `DetectionRun`.
        begins_rev: revolution at which each of the modes begins, the healthy one first.
        end_rev: end of the run.

    Returns:
        float64 ``[M]``.
    """
    delays = np.full(len(begins_rev), np.inf)
    for mode, (begin, end) in enumerate(itertools.pairwise([*begins_rev, end_rev])):
        at = [(sample / SAMPLES_PER_REV, declared) for sample, declared in changes]
        before = [declared for rev, declared in at if rev < begin]
        if before and before[-1] == mode:
            delays[mode] = 0.0
        else:
            after_rev = (rev - begin for rev, declared in at if declared == mode and begin <= rev < end)
            delays[mode] = min(after_rev, default=np.inf)
    return delays


def wrong_changes(changes: Sequence[tuple[int, int]], begins_rev: Sequence[float]) -> int:
    """Changes of the declared mode to one that the machine is not in.

    The mode before a change is excused for three revolutions; a mode that is passed on the way counts.

    Args:
        changes: as in `DetectionRun`.
        begins_rev: revolution at which each of the modes begins, the healthy one first.
    """
    wrong = 0
    for sample, declared in changes:
        rev = sample / SAMPLES_PER_REV
        true = int(np.searchsorted(begins_rev, rev, side="right")) - 1
        excused = declared == true - 1 and rev - begins_rev[true] < _EXCUSED_REV
        wrong += declared != true and not excused
    return wrong
