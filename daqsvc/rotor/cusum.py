"""Compiled CUSUM of log-likelihood ratios between the modes of a bank (Page 1954)."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from numba import njit

from daqsvc.rotor.kernels import UNDETERMINED

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    Floats = NDArray[np.float64]
    Ints = NDArray[np.int64]
    Flags = NDArray[np.bool_]

_PATIENCE = 3.0


@njit(cache=True, nogil=True, error_model="numpy")
def _first_verdict(scores: Floats, k: int, threshold: float, alike: Flags, duels: Floats) -> int:
    """Every mode against every other; the index of one that leads all unlike it by the threshold, or -1."""
    count = len(scores)
    winner = UNDETERMINED
    for i in range(count):
        narrowest = math.inf
        for j in range(count):
            if i != j:
                duels[i, j] = max(0.0, duels[i, j] + scores[i, k] - scores[j, k])
                if not alike[i, j]:
                    narrowest = min(narrowest, duels[i, j])
        if narrowest >= threshold and (winner == UNDETERMINED or duels[i, winner] > duels[winner, i]):
            winner = i
    return winner


@njit(cache=True, nogil=True, error_model="numpy")
def _gather(scores: Floats, k: int, current: int, cusum: Floats, ages: Ints) -> None:
    """One sample's evidence of every mode against the declared one."""
    for j in range(len(scores)):
        cusum[j] = cusum[j] + scores[j, k] - scores[current, k]
        if cusum[j] <= 0.0:
            cusum[j] = 0.0
            ages[j] = 0


@njit(cache=True, nogil=True, error_model="numpy")
def _next_verdict(
    current: int,
    thresholds: Floats,
    identity_margin: float,
    settling: int,
    alike: Flags,
    cusum: Floats,
    ages: Ints,
) -> tuple[int, int]:
    """The mode with a threshold of evidence against the declared one, and the one that takes over, or -1.

    A transient passes by the mildest faults, so for a moment several are past their thresholds. Who
    takes over must lead the rest by the margin; past three thresholds it need not any more, for on a
    machine that lies between two levels neither ever leads. Where many faults are told apart that is not
    enough, and the transient is given time to settle. A mode that looks like the declared one cannot take
    over from it, and one that looks like the leading one does not hold it up.
    """
    winner = UNDETERMINED
    for j in range(len(cusum)):
        if cusum[j] > 0.0 and not alike[current, j] and (winner == UNDETERMINED or cusum[j] > cusum[winner]):
            winner = j
    if winner == UNDETERMINED or cusum[winner] < thresholds[current, winner]:
        return UNDETERMINED, UNDETERMINED
    second = 0.0
    for j in range(len(cusum)):
        if j != winner and not alike[winner, j] and not alike[current, j]:
            second = max(second, cusum[j])
    best = cusum[winner]
    if ages[winner] < settling:
        return winner, UNDETERMINED
    if best - second < identity_margin and best < _PATIENCE * thresholds[current, winner]:
        return winner, UNDETERMINED
    return winner, winner


@njit(cache=True, nogil=True, error_model="numpy")
def decide_by_cusum(
    scores: Floats,
    thresholds: Floats,
    first_threshold: float,
    identity_margin: float,
    settling: int,
    lead_limit: float,
    alike: Flags,
    current: int,
    cusum: Floats,
    lead: Floats,
    duels: Floats,
    ages: Ints,
    verdicts: Ints,
    suspects: Ints,
    onsets: Ints,
) -> int:
    """CUSUM of log-likelihood ratios over free-running observers (Page 1954).

    Args:
        scores: float64 ``[M, n]``, log-likelihoods from `run_free`, nats.
        thresholds: float64 ``[M, M]``, nats that change the decision from the row's mode to the column's.
        first_threshold: nats by which one mode must lead all others to be the first decision.
        identity_margin: nats by which the next decision must lead the other candidates.
        settling: samples since the onset of its evidence that the next decision must wait for.
        lead_limit: the lead of the decision over another mode counts up to here.
        alike: bool ``[M, M]``, pairs that no lead is asked of and no change is made between.
        current: index of the decision before the block, or -1.
        cusum: float64 ``[M]``, evidence of each mode against the decision since its onset, changed in place.
        lead: float64 ``[M]``, evidence of the decision over each mode, changed in place.
        duels: float64 ``[M, M]``, evidence of row over column until there is a decision, changed in place.
        ages: int64 ``[M]``, samples since the onset of each CUSUM, changed in place.
        verdicts: int64 ``[n]``, out: mode declared at each sample, or -1.
        suspects: int64 ``[n]``, out: leading mode while it has the evidence but not the margin, or -1.
        onsets: int64 ``[n]``, out: for a verdict or a suspect, how many samples its evidence goes back.

    Returns:
        Index of the decision after the block, or -1.
    """
    count, n = scores.shape
    for k in range(n):
        for j in range(count):
            ages[j] += 1
        suspects[k] = UNDETERMINED
        if current == UNDETERMINED:
            winner = _first_verdict(scores, k, first_threshold, alike, duels)
        else:
            _gather(scores, k, current, cusum, ages)
            suspect, winner = _next_verdict(
                current, thresholds, identity_margin, settling, alike, cusum, ages
            )
            if suspect != UNDETERMINED:
                onsets[k] = ages[suspect]
                if winner == UNDETERMINED:
                    suspects[k] = suspect
            for j in range(count):
                lead[j] = min(lead_limit, lead[j] + scores[current, k] - scores[j, k])
        verdicts[k] = winner
        if winner != UNDETERMINED:
            onsets[k] = ages[winner]
            for j in range(count):
                won = duels[winner, j] if current == UNDETERMINED else cusum[winner] - cusum[j]
                lead[j] = min(lead_limit, won)
            cusum[:] = 0.0
            ages[:] = 0
            current = winner
    return current
