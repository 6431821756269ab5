"""Compiled CUSUM of log-likelihood ratios between the modes of a bank (Page 1954).

It stands by one mode; every other gathers evidence against that one since an onset of its own. As long as
nothing is declared, all modes are compared with all.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from numba import njit

from daqsvc.rotor.kernels import UNDETERMINED
from daqsvc.rotor.observer_batch import WIDTH

if TYPE_CHECKING:
    from typing import Any

    import numpy as np
    from numpy.typing import NDArray

    Batch = NDArray[np.void]
    Pairs = NDArray[np.void]
    Group = Any  # one element of Lanes: numba makes a record of it
    Desk = Any

_PATIENCE = 3.0


@njit(cache=True, nogil=True, error_model="numpy")
def gather(group: Group, own: float, lead_limit: float, width: int) -> int:
    """One sample's evidence of a group's modes against the declared one.

    Args:
        group: of `batch.LANES`; its scores are the sample's.
        own: log-likelihood of the sample under the declared mode.
        lead_limit: the lead of the declared mode counts up to here.
        width: lanes that there are modes in.

    Returns:
        How many modes have the evidence that it takes to change the decision.
    """
    score, cusum, lead, age, threshold = group.score, group.cusum, group.lead, group.age, group.threshold
    enough = 0
    for i in range(width):
        evidence = cusum[i] + score[i] - own
        gathers = evidence > 0.0
        cusum[i] = evidence if gathers else 0.0
        age[i] = age[i] + 1 if gathers else 0
        led = lead[i] + own - score[i]
        lead[i] = min(lead_limit, led)
        enough += evidence >= threshold[i]
    return enough


@njit(cache=True, nogil=True, error_model="numpy")
def first_verdict(batch: Batch, pairs: Pairs, header: Desk) -> int:
    """One sample's evidence of every mode against every other; a mode that leads all unlike it, or -1.

    Args:
        batch: memory of the bank; ages go on.
        pairs: ``[M M]`` of `batch.PAIR`; the duels go on.
        header: of `batch.HEADER`.
    """
    count = header.modes
    winner = UNDETERMINED
    for i in range(count):
        group, lane = batch[i // WIDTH], i % WIDTH
        group.age[lane] += 1
        narrowest = math.inf
        for j in range(count):
            if i != j:
                pair = pairs[i * count + j]
                pair.log_ratio = max(
                    0.0, pair.log_ratio + group.score[lane] - batch[j // WIDTH].score[j % WIDTH]
                )
                if pair.threshold < math.inf:
                    narrowest = min(narrowest, pair.log_ratio)
        if narrowest >= header.first_threshold and (
            winner == UNDETERMINED
            or pairs[i * count + winner].log_ratio > pairs[winner * count + i].log_ratio
        ):
            winner = i
    return winner


@njit(cache=True, nogil=True, error_model="numpy")
def next_verdict(batch: Batch, pairs: Pairs, header: Desk) -> tuple[int, int]:
    """The mode with a threshold of evidence against the declared one, and the one that takes over, or -1.

    A transient passes by the mildest faults, so for a moment several are past their thresholds. Who
    takes over must lead the rest by the margin; past three thresholds it need not any more, for on a
    machine that lies between two levels neither ever leads. Where many faults are told apart that is not
    enough, and the transient is given time to settle. A mode that looks like the declared one cannot take
    over from it, and one that looks like the leading one does not hold it up.

    Args:
        batch: memory of the bank.
        pairs: ``[M M]`` of `batch.PAIR`.
        header: of `batch.HEADER`.
    """
    count = header.modes
    row = header.decision * count
    winner, best = UNDETERMINED, 0.0
    for j in range(count):
        evidence = batch[j // WIDTH].cusum[j % WIDTH]
        if evidence > best and pairs[row + j].threshold < math.inf:
            winner, best = j, evidence
    if winner == UNDETERMINED or best < pairs[row + winner].threshold:
        return UNDETERMINED, UNDETERMINED
    threshold = pairs[row + winner].threshold
    second = 0.0
    for j in range(count):
        if (
            j != winner
            and pairs[winner * count + j].threshold < math.inf
            and pairs[row + j].threshold < math.inf
        ):
            second = max(second, batch[j // WIDTH].cusum[j % WIDTH])
    if batch[winner // WIDTH].age[winner % WIDTH] < header.settling_wait:
        return winner, UNDETERMINED
    if best - second < header.identity_nats and best < _PATIENCE * threshold:
        return winner, UNDETERMINED
    return winner, winner


@njit(cache=True, nogil=True, error_model="numpy")
def stand_by(mode: int, batch: Batch, pairs: Pairs, header: Desk) -> None:
    """Make a mode the decision: its lead is what it won by, and the evidence starts anew.

    Args:
        mode: index of the mode.
        batch: memory of the bank.
        pairs: ``[M M]`` of `batch.PAIR`.
        header: of `batch.HEADER`.
    """
    won = batch[mode // WIDTH].cusum[mode % WIDTH]
    for j in range(header.modes):
        group, lane = batch[j // WIDTH], j % WIDTH
        pair = pairs[mode * header.modes + j]
        lead = pair.log_ratio if header.decision == UNDETERMINED else won - group.cusum[lane]
        group.lead[lane] = min(header.lead_limit, lead)
        group.threshold[lane] = pair.threshold
    for g in range(len(batch)):
        batch[g].cusum[:] = 0.0
        batch[g].age[:] = 0
    header.decision = mode
