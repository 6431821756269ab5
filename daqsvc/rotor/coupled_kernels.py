"""Steps of observers with coupled axes: what `kernels` does for the paper's rotor."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from daqsvc.kernels import njit
from daqsvc.rotor.kernels import ESCAPE_RADIUS

if TYPE_CHECKING:
    from typing import Any

    from numpy.typing import NDArray

    Floats = NDArray[np.float64]
    Flags = NDArray[np.bool_]
    Observers = NDArray[np.void]
    Couplings = NDArray[np.void]
    Observer = Any  # one element of each: numba makes records of them
    Coupling = Any
    State = tuple[float, float, float, float]

_ESCAPE_SQUARED = ESCAPE_RADIUS * ESCAPE_RADIUS
_NEAR_SQUARED = 0.8 * 0.8
"""An orbit that stays farther than this from the housing does not rub, however wrong the clearance may be."""


@njit(cache=True, nogil=True, error_model="numpy")
def orbit(observer: Observer, coupling: Coupling, cos: float, sin: float) -> State:
    """Position and velocity on an observer's reference orbit, an ellipse, at a shaft angle."""
    u = observer.a * cos - observer.b * sin
    v = observer.a * sin + observer.b * cos
    p = coupling.back_a * cos + coupling.back_b * sin
    q = coupling.back_b * cos - coupling.back_a * sin
    speed = observer.speed
    return u + p + observer.rest_x, speed * (q - v), v + q + observer.rest_y, speed * (u - p)


@njit(cache=True, nogil=True, error_model="numpy")
def _flow(matrix: Floats, state: State) -> State:
    x, u, y, v = state
    return (
        matrix[0, 0] * x + matrix[0, 1] * u + matrix[0, 2] * y + matrix[0, 3] * v,
        matrix[1, 0] * x + matrix[1, 1] * u + matrix[1, 2] * y + matrix[1, 3] * v,
        matrix[2, 0] * x + matrix[2, 1] * u + matrix[2, 2] * y + matrix[2, 3] * v,
        matrix[3, 0] * x + matrix[3, 1] * u + matrix[3, 2] * y + matrix[3, 3] * v,
    )


@njit(cache=True, nogil=True, error_model="numpy")
def _kick(observer: Observer, coupling: Coupling, cos: float, sin: float, state: State) -> State:
    """Momentum from the contact in one sub-step, as `kernels` has it."""
    dx, du, dy, dv = state
    ox, ou, oy, ov = orbit(observer, coupling, cos, sin)
    x, y = ox + dx, oy + dy
    squared = x * x + y * y
    if squared <= 1.0:
        return state
    radius = math.sqrt(squared)
    slip = observer.surface_speed + (x * (ov + dv) - y * (ou + du)) / radius
    mu = observer.mu * np.sign(slip)
    impulse = observer.impulse * (radius - 1.0) ** observer.alpha / radius
    return dx, du - impulse * (x - mu * y), dy, dv - impulse * (y + mu * x)


@njit(cache=True, nogil=True, error_model="numpy")
def predict(observer: Observer, coupling: Coupling, cos: float, sin: float, state: State) -> State:
    """One sample ahead; with contact by Strang splitting."""
    if observer.substeps == 0:
        return _flow(coupling.flow, state)
    c, s = observer.half_cos, observer.half_sin
    cos, sin = cos * c - sin * s, sin * c + cos * s
    state = _kick(observer, coupling, cos, sin, _flow(coupling.half, state))
    c, s = observer.full_cos, observer.full_sin
    for _ in range(1, observer.substeps):
        state = _flow(coupling.full, state)
        cos, sin = cos * c - sin * s, sin * c + cos * s
        state = _kick(observer, coupling, cos, sin, state)
    return _flow(coupling.half, state)


@njit(cache=True, nogil=True, error_model="numpy")
def guarded(
    observer: Observer,
    coupling: Coupling,
    healthy: Observer,
    of_healthy: Coupling,
    cos: float,
    sin: float,
    state: State,
) -> State:
    """The state of a rub observer, or a new start on the healthy orbit if it is lost (escaped or NaN)."""
    ox, ou, oy, ov = orbit(observer, coupling, cos, sin)
    x, y = ox + state[0], oy + state[2]
    if x * x + y * y < _ESCAPE_SQUARED and math.isfinite(state[1] + state[3]):
        return state
    hx, hu, hy, hv = orbit(healthy, of_healthy, cos, sin)
    return hx - ox, hu - ou, hy - oy, hv - ov


@njit(cache=True, nogil=True, error_model="numpy")
def touches(coupling: Coupling, x: float, y: float) -> bool:
    """Whether a rub observer's estimate has come near the housing recently.

    The observer of a rub is noisy by design, so that it follows contacts that it does not know. It also
    follows anything else that fits no mode; without contact that is no evidence of a rub.

    Args:
        coupling: of the observer; how far it has been is kept in it.
        x: its estimated position, in clearances.
        y: the same.
    """
    coupling.reach_squared = max(coupling.forgetting * coupling.reach_squared, x * x + y * y)
    return coupling.reach_squared > _NEAR_SQUARED  # type: ignore[no-any-return]


@njit(cache=True, nogil=True, error_model="numpy")
def correct(coupling: Coupling, z_x: float, z_y: float, state: State) -> tuple[State, float]:
    """Kalman update by one sample, counted from the orbit; also the innovation's log-likelihood, nats."""
    dx, du, dy, dv = state
    ex, ey = z_x - dx, z_y - dy
    gain, precision = coupling.gain, coupling.precision
    power = precision[0, 0] * ex * ex + 2.0 * precision[0, 1] * ex * ey + precision[1, 1] * ey * ey
    state = (
        dx + gain[0, 0] * ex + gain[0, 1] * ey,
        du + gain[1, 0] * ex + gain[1, 1] * ey,
        dy + gain[2, 0] * ex + gain[2, 1] * ey,
        dv + gain[3, 0] * ex + gain[3, 1] * ey,
    )
    return state, -0.5 * power - coupling.log_norm


@njit(cache=True, nogil=True, error_model="numpy")
def change_orbits(
    before: Observers,
    coupled_before: Couplings,
    after: Observers,
    coupled_after: Couplings,
    cos: float,
    sin: float,
    states: Floats,
) -> None:
    """Keep every estimate while the orbits that it is counted from change; see `kernels.change_orbits`."""
    for i in range(len(states)):
        bx, bu, by, bv = orbit(before[i], coupled_before[i], cos, sin)
        ax, au, ay, av = orbit(after[i], coupled_after[i], cos, sin)
        states[i, 0] += bx - ax
        states[i, 1] += bu - au
        states[i, 2] += by - ay
        states[i, 3] += bv - av


@njit(cache=True, nogil=True, error_model="numpy")
def run_free(
    xy: Floats,
    cos: Floats,
    sin: Floats,
    observers: Observers,
    couplings: Couplings,
    states: Floats,
    scores: Floats,
) -> None:
    """Free-running observers over a block in which no sample is missing.

    Args:
        xy: float64 ``[n, 2]``, measured position in clearances.
        cos: float64 ``[n]``, cosine of the shaft angle.
        sin: float64 ``[n]``, its sine.
        observers: ``[M]`` of `discretise.OBSERVER`.
        couplings: ``[M]`` of `coupled.COUPLED`.
        states: float64 ``[M, 4]``, deviations at the first sample; left at the sample after the last.
        scores: float64 ``[M, n]``, out: log-likelihood of every sample under every mode, nats.
    """
    for i in range(len(states)):
        observer, coupling = observers[i], couplings[i]
        state = (states[i, 0], states[i, 1], states[i, 2], states[i, 3])
        for k in range(len(xy)):
            if observer.substeps > 0:
                state = guarded(observer, coupling, observers[0], couplings[0], cos[k], sin[k], state)
            ox, _, oy, _ = orbit(observer, coupling, cos[k], sin[k])
            state, scores[i, k] = correct(coupling, xy[k, 0] - ox, xy[k, 1] - oy, state)
            state = predict(observer, coupling, cos[k], sin[k], state)
        states[i, 0], states[i, 1], states[i, 2], states[i, 3] = state
