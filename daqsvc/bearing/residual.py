"""The residual that the service runs: the exact inverse of the faults, high-passed so that it is stable.

Newton's equations give the force of each faulty spring from what the two accelerometers measure:

    m_b a_b = v - m_r a_r - m_h a_h - (k_h / s^2 + c_h / s) a_h         (the momentum of all three masses)
    D_in u_in = a_r + (k_s / s^2 + c_s / s) (a_r - a_b) / m_r - v / m_r
    D_out u_out = a_h - [(k_c / s^2 + c_c / s) (a_b - a_h) - (k_h / s^2 + c_h / s) a_h] / m_h

These hold four integrations, which no filter may run: they are the invariant zeros of the model at s = 0. A
high-pass hp(s) = (s / (s + w0))^6 takes them and a sensor's offset out, and what remains is stable with all
poles at -w0. Then residual = hp(s) D G(s)^-1 (y - G_v v), and so residual i = hp(s) D_i u_i, whatever the
other race does.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from numpy.polynomial import polynomial
from scipy.signal import cont2discrete

from daqsvc.kernels import njit

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from daqsvc.bearing.model import BearingParameters, Complexes, Floats

    Records = NDArray[np.void]

ORDER = 6
"""Lags in a chain of the residual generator."""
GENERATOR = np.dtype(
    [
        # pole of every lag, and the samples after a start without a residual
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
    """Run the residual generator over a block; see the top of this module for what it is made of.

    A row with a missing input gives a missing residual; after it the generator starts again from rest and is
    silent until it has settled.

    Args:
        inputs: float64 ``[4 + n, 3]``: accelerations of rotor and housing, force of the unbalance, after the
            four rows of the last block; changed where the generator starts again.
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
            predicted = state[i] + feed[0, i] * a + feed[1, i] * b + feed[2, i] * c
            predicted += direct[0, i] * x + direct[1, i] * y + direct[2, i] * z
            residual[n, i] = predicted if wait == 0 else np.nan
        for k in range(12):
            # A lag needs its own old state and that of the next of its race: the update is in place.
            fresh = drive[0, k] * a + drive[1, k] * b + drive[2, k] * c
            state[k] = stay * state[k] + move * state[k + 2] + fresh
        if wait > 0:
            wait -= 1
    memory.unsettled = wait


CORNER_HZ = 300.0
DELAY = 2
"""Samples by which the residual is behind the accelerations: the compensation of the hold looks ahead."""
_SETTLED = 30.0
"""Time constants after which the generator has settled: (w0 t)^5 exp(-w0 t) / 5! < 1e-7."""
_MOST_PER_NYQUIST = 0.8


class TwoSensorResidual:
    """From the accelerations of rotor and housing to what each race of a bearing adds to them.

    Works block by block; where blocks are cut makes no difference. Missing samples (NaN) make the residual
    missing until the generator has settled again, as it is at the start.

    Args:
        parameters: of the healthy bearing.
        rate_hz: sampling rate.
        corner_hz: w0 / 2 pi of the high-pass.

    Attributes:
        settling: samples after a start, or after missing ones, without a residual.

    Raises:
        ValueError: the corner is not between 0 and 0.8 times the Nyquist frequency.
    """

    def __init__(
        self, parameters: BearingParameters, rate_hz: float, *, corner_hz: float = CORNER_HZ
    ) -> None:
        if not 0.0 < corner_hz < _MOST_PER_NYQUIST * rate_hz / 2.0:
            raise ValueError(
                f"bearing residual: a corner of {corner_hz:g} Hz at {rate_hz:g} samples a second; it must be "
                f"above 0 and below {_MOST_PER_NYQUIST * rate_hz / 2.0:g} Hz: lower it, or sample faster"
            )
        self.parameters = parameters
        self.rate_hz = rate_hz
        self.corner_hz = corner_hz
        self._taps = chain_taps(parameters, corner_hz)
        self._stay, self._drive, self._feed = _discretise(self._taps, corner_hz, rate_hz)
        self.settling = math.ceil(_SETTLED / (2.0 * math.pi * corner_hz) * rate_hz)
        self._past = np.zeros((4, 3))
        self._design = np.zeros(1, dtype=GENERATOR)
        design = self._design[0]
        design["stay"], design["settling"] = self._stay, self.settling
        rest = self._drive[::-1].cumsum(axis=0)[::-1] / (1.0 - self._stay)
        matrices = {"drive": self._drive, "rest": rest, "feed": self._feed, "direct": self._taps[0]}
        for name, matrix in matrices.items():
            design[name] = np.moveaxis(matrix, -1, 0).reshape(3, -1)
        self._memory = np.zeros(1, dtype=MEMORY)
        self.reset()

    def process(self, y: NDArray[np.floating], v: NDArray[np.floating] | None = None) -> Floats:
        """Take in a block.

        Args:
            y: ``[n, 2]``, accelerations of rotor and housing in m/s^2.
            v: ``[n]``, force of the known unbalance on the rotor in N; none if not given.

        Returns:
            float64 ``[n, 2]`` in m/s^2: hp D_in u_in and hp D_out u_out; NaN where missing.

        Raises:
            ValueError: the shapes do not fit.
        """
        if y.ndim != 2 or y.shape[1] != 2 or (v is not None and v.shape != (len(y),)):
            raise ValueError(
                f"bearing residual: accelerations {list(y.shape)} and force "
                f"{None if v is None else list(v.shape)}; they must be [n, 2] (rotor, housing) and [n]"
            )
        inputs = np.empty((4 + len(y), 3))
        inputs[:4] = self._past
        # Column by column: rows of two would be copied two by two.
        inputs[4:, 0], inputs[4:, 1] = y[:, 0], y[:, 1]
        inputs[4:, 2] = 0.0 if v is None else v
        residual = np.empty((len(y), 2))
        separate(inputs, self._design, self._memory, residual)
        self._past = inputs[len(y) :].copy()
        return residual

    def reset(self) -> None:
        """Forget everything: the next sample starts again."""
        self._memory["unsettled"] = -1

    def response(self, frequency_hz: Floats) -> Complexes:
        """Response before discretisation, complex128 ``[n, 2, 3]``: residual, input (a_r, a_h, v)."""
        s = 2j * np.pi * np.asarray(frequency_hz, dtype=np.float64)
        w0 = 2.0 * math.pi * self.corner_hz
        lag = w0 / (s + w0)
        return np.asarray(np.einsum("nm,mij->nij", lag[:, None] ** np.arange(ORDER + 1), self._taps))

    def sampled_response(self, frequency_hz: Floats) -> Complexes:
        """The same for the recursion that runs, at frequencies below the Nyquist frequency."""
        z = np.exp(2j * np.pi * np.asarray(frequency_hz, dtype=np.float64) / self.rate_hz)
        lead = np.zeros((len(z), 2, 3), dtype=np.complex128)
        for drive in self._drive[::-1]:
            lead = ((1.0 - self._stay) * lead + drive) / (z - self._stay)[:, None, None]
        near, far = 2.0 * np.cos(np.angle(z)), 2.0 * np.cos(2.0 * np.angle(z))
        held = (WHOLE + NEAR * near + FAR * far)[:, None, None]
        return np.asarray((held * (lead + self._feed) + self._taps[0]) / z[:, None, None] ** DELAY)


def inverse_in_integrations(parameters: BearingParameters) -> Floats:
    """D G(s)^-1 (y - G_v v) as a polynomial in 1/s.

    Args:
        parameters: of the healthy bearing.

    Returns:
        float64 ``[5, 2, 3]``: power of 1/s, race, input (a_r, a_h, v).
    """
    p = parameters
    one = np.array([1.0])
    a_r, a_h, v = 0, 1, 2
    housing = np.array([0.0, p.c_h, p.k_h])
    ball = [-p.m_r * one, polynomial.polyadd(-p.m_h * one, -housing), one]
    ball = [force / p.m_b for force in ball]
    taps = np.zeros((5, 2, 3))

    def add(race: int, channel: int, powers: Floats) -> None:
        taps[: len(powers), race, channel] += powers

    shaft = np.array([0.0, p.c_s, p.k_s]) / p.m_r
    contact = np.array([0.0, p.c_c, p.k_c]) / p.m_h
    add(0, a_r, one)
    add(0, a_r, shaft)
    add(0, v, -one / p.m_r)
    add(1, a_h, one)
    add(1, a_h, contact)
    add(1, a_h, housing / p.m_h)
    for channel in (a_r, a_h, v):
        add(0, channel, -polynomial.polymul(shaft, ball[channel]))
        add(1, channel, -polynomial.polymul(contact, ball[channel]))
    return taps


def chain_taps(parameters: BearingParameters, corner_hz: float) -> Floats:
    """The generator hp D G^-1 as a polynomial in the lag w0 / (s + w0).

    s / (s + w0) = 1 - lag and 1 / s = lag / (w0 (1 - lag)), so that a power k of 1/s under the high-pass
    is lag^k (1 - lag)^(6 - k) / w0^k.

    Returns:
        float64 ``[7, 2, 3]``: power of the lag, race, input.
    """
    w0 = 2.0 * math.pi * corner_hz
    powers = inverse_in_integrations(parameters)
    taps = np.zeros((ORDER + 1, *powers.shape[1:]))
    for k, coefficients in enumerate(powers):
        lags = polynomial.polypow([1.0, -1.0], ORDER - k) / w0**k
        taps[k:] += lags[:, None, None] * coefficients
    return taps


def _discretise(taps: Floats, corner_hz: float, rate_hz: float) -> tuple[float, Floats, Floats]:
    """A chain of lags for each race, x_m' = w0 (tap_m in + x_m+1 - x_m), held at first order.

    A zero-order hold of the accelerations would leak three times a healthy machine's own 1X.
    The held chain steps by stay exp(w0 T N), N the shift; the basis is then changed so that a lag needs the
    next one only: x_m <- stay x_m + (1 - stay) x_m+1 + drive_m in.

    Returns:
        stay, drive ``[6, 2, 3]``, and feed ``[2, 3]`` without what goes past the chain.
    """
    w0 = 2.0 * math.pi * corner_hz
    A = w0 * (np.eye(ORDER, k=1) - np.eye(ORDER))
    C = np.eye(ORDER)[:1]
    stay = math.exp(-w0 / rate_hz)
    drive, feed = np.empty((ORDER, 2, 3)), np.empty((2, 3))
    for race in (0, 1):
        system = (A, w0 * taps[1:, race], C, taps[:1, race])
        flow, drive[:, race], _, feed[race : race + 1], _ = cont2discrete(system, 1.0 / rate_hz, method="foh")
        basis = C
        for _ in range(1, ORDER):
            basis = np.vstack((basis, basis[-1:] @ (flow - stay * np.eye(ORDER)) / (1.0 - stay)))
        drive[:, race] = basis @ drive[:, race]
    # What goes past the chain knows no hold.
    return stay, drive, feed - taps[0]
