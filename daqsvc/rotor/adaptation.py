"""A bank made to fit its own machine: orbit and rest measured over healthy revolutions.

No machine file knows the unbalance to a few per cent, and the bank takes the difference for a fault. What
it measures while the machine is healthy goes into every mode as what healthy is, so that a fault is a
change from there.
"""

from __future__ import annotations

import cmath
import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from daqsvc.rotor.synchronous.vectors import LEAST_SAMPLES_OF_3X

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from daqsvc.rotor.discretise import BankMode

    Complexes = NDArray[np.complex128]
    Floats = NDArray[np.float64]

VARIANCE_FACTOR = 1.5
"""How much larger than their own figure the innovations' variance is taken to be after an adaptation. This
allows for errors of natural frequency and damping of a few per cent."""
MODEL_ERROR = 0.1
"""Part of the healthy orbit that a rotor with two modes may be off by after a fault."""


@dataclass(frozen=True, slots=True)
class SteadyMotion:
    """The steady motion z = forward exp(i theta) + backward exp(-i theta) + rest, in clearances.

    Attributes:
        forward: radius of the part that turns with the shaft.
        backward: radius of the part that turns against it; 0 on the paper's rotor.
        rest: centre.
        samples: number of samples that it was fitted to.
        harmonics: 2X and 3X of what it leaves over, each forward and backward; None if not looked for, or
            if a revolution has too few samples for it.
    """

    forward: complex
    backward: complex
    rest: complex
    samples: int
    harmonics: tuple[complex, complex, complex, complex] | None = None

    def with_harmonics(self, xy: Floats, cos: Floats, sin: Floats) -> SteadyMotion:
        """The same motion with its harmonics, from the samples of about a revolution that it was fitted to.

        Args:
            xy: float64 ``[n, 2]``, position.
            cos: float64 ``[n]``, cosine of the shaft angle.
            sin: float64 ``[n]``, its sine.
        """
        if self.samples < LEAST_SAMPLES_OF_3X:
            return self
        turn, z = _there(xy, cos, sin)
        left = z - (self.forward * turn + self.backward * turn.conj() + self.rest)
        twice = turn * turn
        thrice = twice * turn
        sums = (np.vdot(twice, left), np.dot(twice, left), np.vdot(thrice, left), np.dot(thrice, left))
        a, b, c, d = (complex(one) / self.samples for one in sums)
        return replace(self, harmonics=(a, b, c, d))


class SteadyFit:
    """Least squares of z on {exp(i theta), exp(-i theta), 1}, gathered block by block."""

    def __init__(self) -> None:
        # Sums over the samples: exp(i theta), exp(2 i theta); z exp(-i theta), z exp(i theta), z.
        self._turn = self._twice = 0j
        self._moment = np.zeros(3, dtype=np.complex128)
        self.samples = 0
        self._turns = 0.0

    @property
    def turns_per_sample(self) -> float:
        """Mean speed over the samples, in turns of the shaft."""
        return self._turns / max(1, self.samples)

    def add(self, xy: Floats, cos: Floats, sin: Floats, turns_per_sample: float = math.nan) -> None:
        """Take in a block; a sample with anything that is not finite is left out.

        Args:
            xy: float64 ``[n, 2]``, position.
            cos: float64 ``[n]``, cosine of the shaft angle.
            sin: float64 ``[n]``, its sine.
            turns_per_sample: speed of the shaft, where the mean of it is asked for.
        """
        turn, z = _there(xy, cos, sin)
        self._turns += len(turn) * turns_per_sample
        self._turn += complex(turn.sum())
        self._twice += complex(np.dot(turn, turn))
        self._moment += (np.vdot(turn, z), np.dot(turn, z), z.sum())
        self.samples += len(turn)

    def solve(self) -> SteadyMotion:
        """The motion that fits best.

        Raises:
            ValueError: the samples do not cover enough of a revolution to tell the three parts apart.
        """
        n, once, twice = self.samples, self._turn, self._twice
        normal = np.array(
            [
                [n, twice.conjugate(), once.conjugate()],
                [twice, n, once],
                [once, once.conjugate(), n],
            ]
        )
        # Over whole revolutions the sums are small: by Gershgorin's circles the condition is below 3 then.
        sound = max(abs(once) + abs(twice), 2.0 * abs(once)) < n / 2.0
        if n < 3 or (not sound and np.linalg.cond(normal) > 1e6):
            raise ValueError(f"{self.samples} samples do not cover a revolution; take more of them")
        forward, backward, rest = np.linalg.solve(normal, self._moment).tolist()
        return SteadyMotion(forward, backward, rest, self.samples)


def _there(xy: Floats, cos: Floats, sin: Floats) -> tuple[Complexes, Complexes]:
    """Shaft angle as exp(i theta) and position z of the samples that are finite."""
    turn = np.empty(len(cos), np.complex128)
    turn.real, turn.imag = cos, sin
    z = np.ascontiguousarray(xy).view(np.complex128)[:, 0]
    known = np.isfinite(turn) & np.isfinite(z)
    return (turn, z) if known.all() else (turn[known], z[known])


def adapted(modes: Sequence[BankMode], motion: SteadyMotion, speed: float) -> tuple[BankMode, ...]:
    """The same modes about the machine as it was measured: complex unbalance and static load of all.

    Args:
        modes: the hypotheses, healthy first.
        motion: the healthy machine's.
        speed: normalised speed that it was measured at.

    Raises:
        ValueError: the healthy mode has no unbalance, or the machine showed none, so that there is no phase
            to take over.
    """
    healthy = modes[0].rotor
    modelled = healthy.orbit(speed) - healthy.runout[1]
    if not modelled or not motion.forward:
        raise ValueError(
            f"rotor bank: an orbit of {abs(motion.forward):.3g} clearances cannot be compared with one of "
            f"{abs(modelled):.3g}; give the rotor the unbalance that it has"
        )
    ratio = motion.forward / modelled
    turned = [
        replace(
            mode.rotor,
            e=mode.rotor.e * abs(ratio),
            heavy_spot_rad=math.remainder(mode.rotor.heavy_spot_rad + cmath.phase(ratio), math.tau),
            runout=(0j, 0j, 0j),
        )
        for mode in modes
    ]
    if healthy.isotropic:
        load = healthy.load_for(motion.rest - healthy.rest)
        rotors = [replace(one, g=one.g - load.imag, load_x=one.load_x + load.real) for one in turned]
    else:
        # Forward 1X is the model's by now. What is left of the rest no mode explains: it stays as it is.
        rest, backward = motion.rest - turned[0].rest, motion.backward - turned[0].backward_orbit(speed)
        rotors = [replace(one, runout=(rest, 0j, backward)) for one in turned]
    return tuple(replace(mode, rotor=rotor) for mode, rotor in zip(modes, rotors, strict=True))
