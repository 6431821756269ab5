"""Compiled recursions of the bank's observers, one by one; `sweep` runs a whole bank with both rules.

An observer's state is the deviation ``(x, x', y, y')`` of its estimate from its reference orbit. The
linear part of the motion is then homogeneous, and the sum of orbit and deviation is the estimate.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from daqsvc.kernels import njit

if TYPE_CHECKING:
    from typing import Any

    from numpy.typing import NDArray

    Floats = NDArray[np.float64]
    Ints = NDArray[np.int64]
    Flags = NDArray[np.bool_]
    Observers = NDArray[np.void]
    Observer = Any  # one element of it: numba makes a record of it
    State = tuple[float, float, float, float]

ESCAPE_RADIUS = 3.0
"""No disc gets this many clearances from the centre: beyond it an observer is lost, or a sample wrong."""
_ESCAPE_SQUARED = ESCAPE_RADIUS * ESCAPE_RADIUS
UNDETERMINED = -1
"""Index that represents no mode."""


@njit(cache=True, nogil=True, error_model="numpy")
def orbit(observer: Observer, cos: float, sin: float) -> State:
    """Position and velocity on an observer's reference orbit at a shaft angle."""
    u = observer.a * cos - observer.b * sin
    v = observer.a * sin + observer.b * cos
    return u + observer.rest_x, -observer.speed * v, v + observer.rest_y, observer.speed * u


@njit(cache=True, nogil=True, error_model="numpy")
def _flow(xx: float, xv: float, vx: float, vv: float, state: State) -> State:
    """Exact homogeneous flow of both axes."""
    x, u, y, v = state
    return xx * x + xv * u, vx * x + vv * u, xx * y + xv * v, vx * y + vv * v


@njit(cache=True, nogil=True, error_model="numpy")
def _kick(observer: Observer, cos: float, sin: float, state: State) -> State:
    """Momentum from the contact in one sub-step: Hertzian repulsion and Coulomb friction."""
    dx, du, dy, dv = state
    ox, ou, oy, ov = orbit(observer, cos, sin)
    x = ox + dx
    y = oy + dy
    squared = x * x + y * y
    if squared <= 1.0:
        return state
    radius = math.sqrt(squared)
    slip = observer.surface_speed + (x * (ov + dv) - y * (ou + du)) / radius
    mu = observer.mu * np.sign(slip)
    impulse = observer.impulse * (radius - 1.0) ** observer.alpha / radius
    return dx, du - impulse * (x - mu * y), dy, dv - impulse * (y + mu * x)


@njit(cache=True, nogil=True, error_model="numpy")
def predict_rub(observer: Observer, cos: float, sin: float, state: State) -> State:
    """One sample ahead with contact, by Strang splitting, from the shaft angle of the present sample."""
    c, s = observer.half_cos, observer.half_sin
    xx, xv, vx, vv = observer.half_xx, observer.half_xv, observer.half_vx, observer.half_vv
    cos, sin = cos * c - sin * s, sin * c + cos * s
    state = _kick(observer, cos, sin, _flow(xx, xv, vx, vv, state))
    c, s = observer.full_cos, observer.full_sin
    for _ in range(1, observer.substeps):
        state = _flow(observer.full_xx, observer.full_xv, observer.full_vx, observer.full_vv, state)
        cos, sin = cos * c - sin * s, sin * c + cos * s
        state = _kick(observer, cos, sin, state)
    return _flow(xx, xv, vx, vv, state)


@njit(cache=True, nogil=True, error_model="numpy")
def predict(observer: Observer, cos: float, sin: float, state: State) -> State:
    """One sample ahead."""
    if observer.substeps > 0:
        return predict_rub(observer, cos, sin, state)
    return _flow(observer.xx, observer.xv, observer.vx, observer.vv, state)


@njit(cache=True, nogil=True, error_model="numpy")
def transfer(source: Observer, target: Observer, cos: float, sin: float, state: State) -> State:
    """The deviation from the target's orbit that is the same estimate as ``state`` on the source's."""
    dx, du, dy, dv = state
    sx, su, sy, sv = orbit(source, cos, sin)
    tx, tu, ty, tv = orbit(target, cos, sin)
    return dx + sx - tx, du + su - tu, dy + sy - ty, dv + sv - tv


@njit(cache=True, nogil=True, error_model="numpy")
def guarded(observer: Observer, healthy: Observer, cos: float, sin: float, state: State) -> State:
    """The state of a rub observer, or a new start on the healthy orbit if it is lost (escaped or NaN)."""
    ox, _, oy, _ = orbit(observer, cos, sin)
    x, y = ox + state[0], oy + state[2]
    if x * x + y * y < _ESCAPE_SQUARED and math.isfinite(state[1] + state[3]):
        return state
    return transfer(healthy, observer, cos, sin, (0.0, 0.0, 0.0, 0.0))


@njit(cache=True, nogil=True, error_model="numpy")
def deviation(observer: Observer, cos: float, sin: float, x: float, y: float) -> tuple[float, float]:
    """A measured position, counted from an observer's reference orbit."""
    return (
        x - (observer.a * cos - observer.b * sin + observer.rest_x),
        y - (observer.a * sin + observer.b * cos + observer.rest_y),
    )


@njit(cache=True, nogil=True, error_model="numpy")
def correct(observer: Observer, z_x: float, z_y: float, state: State) -> tuple[State, float]:
    """Kalman update by one sample (its `deviation`); also the log-likelihood of the innovation in nats."""
    dx, du, dy, dv = state
    ex, ey = z_x - dx, z_y - dy
    score = -0.5 * (ex * ex + ey * ey) * observer.precision - observer.log_norm
    a, b = observer.gain_x, observer.gain_v
    return (dx + a * ex, du + b * ex, dy + a * ey, dv + b * ey), score


@njit(cache=True, nogil=True, error_model="numpy")
def change_orbits(before: Observers, after: Observers, cos: float, sin: float, states: Floats) -> None:
    """Keep every estimate while the orbits that it is counted from change.

    Args:
        before: ``[M]`` of `discretise.OBSERVER` that the states belong to.
        after: the same observers with other orbits.
        cos: cosine of the shaft angle at the sample that the states are for.
        sin: its sine.
        states: float64 ``[M, 4]``, deviations, changed in place.
    """
    for i in range(len(states)):
        state = (states[i, 0], states[i, 1], states[i, 2], states[i, 3])
        state = transfer(before[i], after[i], cos, sin, state)
        states[i, 0], states[i, 1], states[i, 2], states[i, 3] = state


@njit(cache=True, nogil=True, error_model="numpy")
def _run_linear(
    xy: Floats, usable: Flags, cos: Floats, sin: Floats, observer: Observer, state: State, scores: Floats
) -> State:
    """A linear observer over a block; its state after it.

    Update and prediction are one step of the closed loop, x+ = F (I - K C) x + F K z. It halves the chain
    of operations from a state to the next, which takes most of the time.
    """
    a, b, rest_x, rest_y = observer.a, observer.b, observer.rest_x, observer.rest_y
    xx, xv, vx, vv = observer.xx, observer.xv, observer.vx, observer.vv
    drive_x = xx * observer.gain_x + xv * observer.gain_v
    drive_v = vx * observer.gain_x + vv * observer.gain_v
    closed_xx, closed_vx = xx - drive_x, vx - drive_v
    weight, log_norm = -0.5 * observer.precision, observer.log_norm
    dx, du, dy, dv = state
    for k in range(len(xy)):
        if usable[k]:
            zx = xy[k, 0] - (a * cos[k] - b * sin[k] + rest_x)
            zy = xy[k, 1] - (a * sin[k] + b * cos[k] + rest_y)
            ex, ey = zx - dx, zy - dy
            scores[k] = weight * (ex * ex + ey * ey) - log_norm
            dx, du = closed_xx * dx + (xv * du + drive_x * zx), closed_vx * dx + (vv * du + drive_v * zx)
            dy, dv = closed_xx * dy + (xv * dv + drive_x * zy), closed_vx * dy + (vv * dv + drive_v * zy)
        else:
            scores[k] = 0.0
            dx, du, dy, dv = _flow(xx, xv, vx, vv, (dx, du, dy, dv))
    return dx, du, dy, dv


@njit(cache=True, nogil=True, error_model="numpy")
def _run_rub(
    xy: Floats,
    usable: Flags,
    cos: Floats,
    sin: Floats,
    observer: Observer,
    healthy: Observer,
    state: State,
    scores: Floats,
) -> State:
    """A rub observer over a block; its state after it."""
    for k in range(len(xy)):
        state = guarded(observer, healthy, cos[k], sin[k], state)
        scores[k] = 0.0
        if usable[k]:
            z_x, z_y = deviation(observer, cos[k], sin[k], xy[k, 0], xy[k, 1])
            state, scores[k] = correct(observer, z_x, z_y, state)
        state = predict_rub(observer, cos[k], sin[k], state)
    return state


@njit(cache=True, nogil=True, error_model="numpy")
def run_free(
    xy: Floats, usable: Flags, cos: Floats, sin: Floats, observers: Observers, states: Floats, scores: Floats
) -> None:
    """Free-running observers over a block; each keeps to its own hypothesis.

    Args:
        xy: float64 ``[n, 2]``, measured position in clearances.
        usable: bool ``[n]``; a sample that is not is predicted through and is no evidence.
        cos: float64 ``[n]``, cosine of the shaft angle.
        sin: float64 ``[n]``, its sine.
        observers: ``[M]`` of `discretise.OBSERVER`.
        states: float64 ``[M, 4]``, deviations at the first sample; left at the sample after the last.
        scores: float64 ``[M, n]``, out: log-likelihood of every sample under every mode, nats.
    """
    for i in range(len(states)):
        state = (states[i, 0], states[i, 1], states[i, 2], states[i, 3])
        if observers[i].substeps > 0:
            state = _run_rub(xy, usable, cos, sin, observers[i], observers[0], state, scores[i])
        else:
            state = _run_linear(xy, usable, cos, sin, observers[i], state, scores[i])
        states[i, 0], states[i, 1], states[i, 2], states[i, 3] = state
