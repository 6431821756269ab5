"""Compiled recursions: the residual generator, the sliding units, and the paper's unit in two states."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numba import njit

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Floats = NDArray[np.float64]
    Ints = NDArray[np.int64]


ORDER = 6
"""Lags in a chain of the residual generator."""
WHOLE, NEAR, FAR = 1.0 + 2.0 / 12.0 + 6.0 / 90.0, -1.0 / 12.0 - 4.0 / 90.0, 1.0 / 90.0
"""Symmetric taps 1 + d/12 + d^2/90, d = 2 - z - 1/z, that undo the droop sinc^2 of a first-order hold."""


@njit(cache=True, nogil=True, error_model="numpy")
def separate(  # noqa: C901 - one pass over the samples
    inputs: Floats,
    stay: float,
    drive: Floats,
    feed: Floats,
    direct: Floats,
    rest: Floats,
    settling: int,
    past: Floats,
    state: Floats,
    unsettled: Ints,
    residual: Floats,
) -> None:
    """Run the residual generator over a block; see `daqsvc.bearing.residual` for its matrices.

    A row with a missing input gives a missing residual; after it the generator starts anew from rest and is
    silent until it has settled.

    Args:
        inputs: float64 ``[n, 3]``: accelerations of rotor and housing, force of the unbalance.
        stay: the pole of every lag; the lags of a chain pass on 1 - stay.
        drive: float64 ``[6, 2, 3]``, from the inputs into the lags: lag, race, input.
        feed: float64 ``[2, 3]``, from the inputs through the chains to the residual of the same sample.
        direct: float64 ``[2, 3]``, from the inputs past the chains.
        rest: float64 ``[6, 2, 3]``, state of the lags under constant inputs.
        settling: samples after a start that are not told.
        past: float64 ``[4, 3]``, the inputs before, the oldest first; changed.
        state: float64 ``[7, 2]``, of the lags, the last row 0; changed.
        unsettled: int64 ``[1]``, samples yet to settle, -1 before the first sample; changed.
        residual: float64 ``[n, 2]``, written; two samples behind the inputs.
    """
    move = 1.0 - stay
    held = np.empty(3)
    wait = unsettled[0]
    for n in range(inputs.shape[0]):
        if not np.isfinite(inputs[n, 0] + inputs[n, 1] + inputs[n, 2]):
            residual[n, 0] = residual[n, 1] = np.nan
            wait = -1
            continue
        if wait < 0:
            for j in range(3):
                for m in range(4):
                    past[m, j] = inputs[n, j]
            for m in range(6):
                for i in range(2):
                    state[m, i] = (
                        rest[m, i, 0] * inputs[n, 0]
                        + rest[m, i, 1] * inputs[n, 1]
                        + rest[m, i, 2] * inputs[n, 2]
                    )
            wait = settling
        x, y, z = past[2, 0], past[2, 1], past[2, 2]
        for j in range(3):
            near = past[1, j] + past[3, j]
            held[j] = WHOLE * past[2, j] + NEAR * near + FAR * (past[0, j] + inputs[n, j])
            past[0, j], past[1, j], past[2, j] = past[1, j], past[2, j], past[3, j]
            past[3, j] = inputs[n, j]
        a, b, c = held[0], held[1], held[2]
        for i in range(2):
            told = state[0, i] + feed[i, 0] * a + feed[i, 1] * b + feed[i, 2] * c
            told += direct[i, 0] * x + direct[i, 1] * y + direct[i, 2] * z
            residual[n, i] = told if wait == 0 else np.nan
        for m in range(6):
            # A lag needs its own old state and that of the next: the update is in place.
            for i in range(2):
                fresh = drive[m, i, 0] * a + drive[m, i, 1] * b + drive[m, i, 2] * c
                state[m, i] = stay * state[m, i] + move * state[m + 1, i] + fresh
        if wait > 0:
            wait -= 1
    unsettled[0] = wait


@njit(cache=True, nogil=True, error_model="numpy")
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
    for i in range(2):
        first, second, gain = normals[i, 0], normals[i, 1], gains[i]
        shrink = 1.0 / (1.0 + decays[i])
        s = sigma[i]
        for n in range(residual.shape[0]):
            s += first * residual[n, 0] + second * residual[n, 1]
            if np.isnan(s):
                distance[n, i] = np.nan
                s = 0.0
                continue
            # Beyond the gain the sign is +-1; within it the surface holds the unit (the sign is in between).
            s = (max(s - gain, 0.0) + min(s + gain, 0.0)) * shrink
            distance[n, i] = s
        sigma[i] = s


@njit(cache=True, nogil=True, error_model="numpy")
def slide_in_two_states(
    residual: Floats,
    a: float,
    b: float,
    slope: float,
    gain: Floats,
    step: float,
    implicit: bool,  # noqa: FBT001 - numba has no keyword-only arguments
    state: Floats,
    path: Floats,
) -> None:
    """The paper's unit x1' = x2 - k1 sgn(s) + r1, x2' = -a x1 - b x2 - k2 sgn(s) + r2, s = -slope x1 + x2.

    Args:
        residual: float64 ``[n, 2]``, what drives the unit.
        a: of the free dynamics, in 1/s^2.
        b: of the free dynamics, in 1/s.
        slope: x2 / x1 of the sliding surface.
        gain: float64 ``[2]``, k1 and k2.
        step: in s.
        implicit: whether sgn is taken at the end of a step, with a value between -1 and 1 on the surface;
            else at its beginning, and the unit chatters.
        state: float64 ``[2]``, x1 and x2; changed.
        path: float64 ``[n, 2]``, written: the state after each step.
    """
    x1, x2 = state[0], state[1]
    # Both ways treat the free dynamics alike: (I - step A) x+ = x + step (r - k sgn).
    determinant = 1.0 + step * b + step * step * a
    p11, p12 = (1.0 + step * b) / determinant, step / determinant
    p21, p22 = -step * a / determinant, 1.0 / determinant
    n1, n2 = -slope, 1.0
    pull = step * (n1 * (p11 * gain[0] + p12 * gain[1]) + n2 * (p21 * gain[0] + p22 * gain[1]))
    for n in range(residual.shape[0]):
        f1, f2 = x1 + step * residual[n, 0], x2 + step * residual[n, 1]
        if implicit:
            free = n1 * (p11 * f1 + p12 * f2) + n2 * (p21 * f1 + p22 * f2)
            sign = min(1.0, max(-1.0, free / pull))
        else:
            sign = np.sign(n1 * x1 + n2 * x2)
        f1 -= step * gain[0] * sign
        f2 -= step * gain[1] * sign
        x1, x2 = p11 * f1 + p12 * f2, p21 * f1 + p22 * f2
        path[n, 0], path[n, 1] = x1, x2
    state[0], state[1] = x1, x2
