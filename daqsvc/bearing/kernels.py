"""Compiled recursions: the residual generator and the sliding units."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numba import njit

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Floats = NDArray[np.float64]
    Records = NDArray[np.void]


ORDER = 6
"""Lags in a chain of the residual generator."""
GENERATOR = np.dtype(
    [
        # pole of every lag, and the samples after a start that are not told
        ("stay", np.float64), ("settling", np.int64),
        # from the inputs into the lags, and the state of the lags under constant inputs: input, lag and race
        ("drive", np.float64, (3, 2 * ORDER)), ("rest", np.float64, (3, 2 * ORDER)),
        # from the inputs through the chains, and past them, to the residual of the same sample: input, race
        ("feed", np.float64, (3, 2)), ("direct", np.float64, (3, 2)),
    ]
)  # fmt: skip
"""The constants of a residual generator. The lags of a chain pass on 1 - stay."""
MEMORY = np.dtype([("state", np.float64, (2 * ORDER + 2,)), ("unsettled", np.int64)])
"""State of the lags, lag and race, then two zeros; samples yet to settle, -1 before the first sample."""
WHOLE, NEAR, FAR = 1.0 + 2.0 / 12.0 + 6.0 / 90.0, -1.0 / 12.0 - 4.0 / 90.0, 1.0 / 90.0
"""Symmetric taps 1 + d/12 + d^2/90, d = 2 - z - 1/z, that undo the droop sinc^2 of a first-order hold."""


@njit(cache=True, nogil=True, error_model="numpy")
def _held(before_last: float, before: float, now: float, after: float, after_next: float) -> float:
    """One input with the droop of the hold undone, from two samples on either side."""
    return WHOLE * now + NEAR * (before + after) + FAR * (before_last + after_next)


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def separate(inputs: Floats, designs: Records, memories: Records, residual: Floats) -> None:
    """Run the residual generator over a block; see `daqsvc.bearing.residual` for what it is made of.

    A row with a missing input gives a missing residual; after it the generator starts anew from rest and is
    silent until it has settled.

    Args:
        inputs: float64 ``[4 + n, 3]``: accelerations of rotor and housing, force of the unbalance, after the
            four rows of the last block; changed where the generator starts anew.
        designs: ``[1]`` of `GENERATOR`.
        memories: ``[1]`` of `MEMORY`; changed.
        residual: float64 ``[n, 2]``, written; two samples behind the inputs.
    """
    design, memory = designs[0], memories[0]
    drive, feed, direct, rest = design.drive, design.feed, design.direct, design.rest
    state = memory.state
    wait = memory.unsettled
    stay = design.stay
    move = 1.0 - stay
    for n in range(residual.shape[0]):
        if not np.isfinite(inputs[n + 4, 0] + inputs[n + 4, 1] + inputs[n + 4, 2]):
            residual[n, 0] = residual[n, 1] = np.nan
            wait = -1
            continue
        if wait < 0:
            # As if the inputs had always been what they are now.
            inputs[n : n + 4] = inputs[n + 4]
            a, b, c = inputs[n + 4, 0], inputs[n + 4, 1], inputs[n + 4, 2]
            for k in range(12):
                state[k] = rest[0, k] * a + rest[1, k] * b + rest[2, k] * c
            wait = design.settling
        x, y, z = inputs[n + 2, 0], inputs[n + 2, 1], inputs[n + 2, 2]
        a = _held(inputs[n, 0], inputs[n + 1, 0], x, inputs[n + 3, 0], inputs[n + 4, 0])
        b = _held(inputs[n, 1], inputs[n + 1, 1], y, inputs[n + 3, 1], inputs[n + 4, 1])
        c = _held(inputs[n, 2], inputs[n + 1, 2], z, inputs[n + 3, 2], inputs[n + 4, 2])
        for i in range(2):
            told = state[i] + feed[0, i] * a + feed[1, i] * b + feed[2, i] * c
            told += direct[0, i] * x + direct[1, i] * y + direct[2, i] * z
            residual[n, i] = told if wait == 0 else np.nan
        for k in range(12):
            # A lag needs its own old state and that of the next of its race: the update is in place.
            fresh = drive[0, k] * a + drive[1, k] * b + drive[2, k] * c
            state[k] = stay * state[k] + move * state[k + 2] + fresh
        if wait > 0:
            wait -= 1
    memory.unsettled = wait


@njit(cache=True, nogil=True, error_model="numpy")
def _soft(s: float, gain: float) -> float:
    """What is left of a distance after the gain: beyond it the sign is +-1, within it the surface holds."""
    return max(s - gain, 0.0) + min(s + gain, 0.0)


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def slide(
    residual: Floats, normals: Floats, gains: Floats, decays: Floats, sigma: Floats, distance: Floats
) -> None:
    """Two sliding units in scalar form: leaky sums with a soft threshold (implicit Euler).

    A missing residual puts the units back onto their surfaces and is missing in what they say.

    Args:
        residual: float64 ``[n, 2]``.
        normals: float64 ``[2, 2]``, normal of each unit's surface in the plane of the residual, a row each.
        gains: float64 ``[2]``, what a unit takes off its distance in a step, in units of the residual.
        decays: float64 ``[2]``, what the free dynamics take off in a step, as a share.
        sigma: float64 ``[2]``, distances from the surfaces; changed.
        distance: float64 ``[n, 2]``, written.
    """
    # Both units in one pass: each waits for its own last step, and the other fills the time.
    inner, outer = sigma[0], sigma[1]
    inner_shrink, outer_shrink = 1.0 / (1.0 + decays[0]), 1.0 / (1.0 + decays[1])
    # The shrinking is done before the threshold, which shrinks with it: one step less to wait for.
    i1, i2, inner_gain = inner_shrink * normals[0, 0], inner_shrink * normals[0, 1], inner_shrink * gains[0]
    o1, o2, outer_gain = outer_shrink * normals[1, 0], outer_shrink * normals[1, 1], outer_shrink * gains[1]
    for n in range(residual.shape[0]):
        r1, r2 = residual[n, 0], residual[n, 1]
        inner = _soft(inner_shrink * inner + (i1 * r1 + i2 * r2), inner_gain)
        outer = _soft(outer_shrink * outer + (o1 * r1 + o2 * r2), outer_gain)
        distance[n, 0], distance[n, 1] = inner, outer
        if np.isnan(r1 + r2):
            distance[n, 0] = distance[n, 1] = np.nan
            inner = outer = 0.0
    sigma[0], sigma[1] = inner, outer
