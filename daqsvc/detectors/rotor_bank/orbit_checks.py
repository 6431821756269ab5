"""Whether probes and keyphasor show what the machine file states: direction, static position, speed."""

from __future__ import annotations

import itertools
import math
from collections import deque
from typing import TYPE_CHECKING

import numpy as np

from daqsvc.rotor.adaptation import SteadyFit, SteadyMotion

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    Floats = NDArray[np.float64]

_SIGNIFICANT = 5.0
"""Standard deviations that a part of the orbit must have to be believed."""
_CONTACT_FREE = 0.9
"""An orbit that stays within this part of the clearance is not driven backwards by a rub."""
_BACKWARD = 2.0
"""Backward over forward radius from which the orbit as a whole turns backwards."""
_ERROR = 1.5
"""By this factor a model of the healthy machine may be wrong in how much of its orbit turns backwards."""
_DIRECTION_REVOLUTIONS = 4
_DC_REVOLUTIONS = 4
_NO_DC = 0.25
"""Part of the expected static position below which the probes show none."""
_KEPT_REVOLUTIONS = 128
_SLIP_REVOLUTIONS = 32
_SLIP_PARTS = 4
_SLIP = 0.003
"""Relative difference of orbit's and keyphasor's speed that a real machine cannot have."""
_UNSTEADY = 0.3


class OrbitWatch:
    """Fits the orbit revolution by revolution and states what cannot be true of it.

    Args:
        noise: standard deviation of the measured position, in clearances.
        rest: expected static position, in clearances; 0 if none is to be seen.
        probes: names of the two probes.
        keyphasor: name of the keyphasor.
        backward: backward over forward radius of the healthy orbit. Near a critical speed, supports that are
            softer in one direction turn the whole orbit backwards.
    """

    def __init__(
        self,
        *,
        noise: float,
        rest: complex,
        probes: tuple[str, str],
        keyphasor: str,
        backward: float = 0.0,
    ) -> None:
        self._noise = noise
        self._expected_rest = rest
        self._pair = f"{probes[0]} and {probes[1]}"
        self._keyphasor = keyphasor
        self._static_seen = rest == 0.0
        self._most_backward = max(1.0, _ERROR * backward)
        self.reset()

    def reset(self) -> None:
        """Forget the orbit, for instance after a long gap."""
        self._blocks: list[tuple[Floats, Floats, Floats]] = []
        self._covered = 0
        self._forward = False
        self._motions: deque[SteadyMotion] = deque(maxlen=_KEPT_REVOLUTIONS)
        self._sound, self._spoilt = 0, False
        self._doubt = ""
        self._unclear = ""

    def add(self, xy: Floats, cos: Floats, sin: Floats, revolution: int) -> None:
        """Take in a block.

        Args:
            xy: float64 ``[n, 2]``, position in clearances; NaN where missing.
            cos: float64 ``[n]``, cosine of the shaft angle; NaN where not known.
            sin: float64 ``[n]``, its sine.
            revolution: samples in a revolution.
        """
        self._blocks.append((xy.copy(), cos, sin))
        self._covered += len(xy)
        if self._covered < revolution:
            return
        fit = SteadyFit()
        xy, cos, sin = map(np.concatenate, zip(*self._blocks, strict=True))
        fit.add(xy, cos, sin)
        if fit.samples > revolution // 2:
            self._motions.append(fit.solve().with_harmonics(xy, cos, sin))
            self._sound = 0 if self._spoilt else self._sound + 1
            self._look()
        self._blocks, self._covered, self._spoilt = [], 0, False

    @property
    def confirmed(self) -> bool:
        """Whether the orbit has been seen to turn as it should, or to meet the housing, where it need not.

        Until then the models may not be compared: what is strange to all of them favours the one that
        expects the least.
        """
        return self._forward

    def spoil(self) -> None:
        """The last block is not good: the revolutions with it, and all before, are no motion to compare."""
        self._sound, self._spoilt = 0, bool(self._blocks)

    @property
    def sound_motions(self) -> list[SteadyMotion]:
        """Of the revolutions since the last block that was not good, 128 at most, the oldest first."""
        return list(self._motions)[len(self._motions) - min(self._sound, len(self._motions)) :]

    @property
    def _latest(self) -> list[SteadyMotion]:
        return list(self._motions)[-_SLIP_REVOLUTIONS:]

    def doubt(self) -> str:
        """What cannot be true, with the remedy; empty if nothing is wrong."""
        return self._doubt

    def _look(self) -> None:
        """Look at the orbit with one more revolution."""
        motions = self._latest
        if not self._forward:
            forward = _radius([motion.forward for motion in motions])
            backward = _radius([motion.backward for motion in motions])
            rest = _radius([motion.rest for motion in motions])
            seen = max(forward, backward) > _SIGNIFICANT * self._sigma(motions)
            clear = seen and backward < self._most_backward * forward
            self._forward = clear or forward + backward + rest > _CONTACT_FREE
            unclear = seen and not self._forward and len(motions) == _SLIP_REVOLUTIONS
            self._unclear = _unclear_words(self._pair, forward, backward) if unclear else ""
        self._doubt = self._direction() or self._static_position() or self._slip() or self._unclear

    def _sigma(self, motions: list[SteadyMotion]) -> float:
        """Standard deviation of a mean of one part, complex, over several revolutions."""
        return self._noise * math.sqrt(2.0 / sum(motion.samples for motion in motions))

    def _direction(self) -> str:
        motions = list(self._motions)[-_DIRECTION_REVOLUTIONS:]
        if not motions:
            return ""
        forward = _radius([motion.forward for motion in motions])
        backward = _radius([motion.backward for motion in motions])
        rest = _radius([motion.rest for motion in motions])
        if backward < max(_BACKWARD * self._most_backward * forward, _SIGNIFICANT * self._sigma(motions)):
            return ""
        if forward + backward + rest > _CONTACT_FREE:
            return ""
        return (
            f"{self._pair}: the orbit turns against the stated rotation (1X radius {backward:.3g} clearances "
            f"backward, {forward:.3g} forward); x and y are swapped, or the sign of the speed is wrong: "
            "correct angle_deg of the probes or the direction of rotation"
        )

    def _static_position(self) -> str:
        motions = self._latest
        if self._static_seen or len(motions) < _DC_REVOLUTIONS:
            return ""
        expected = abs(self._expected_rest)
        if expected < 2.0 * _SIGNIFICANT * self._sigma(motions):
            return ""
        seen = _radius([motion.rest for motion in motions])
        if seen >= _NO_DC * expected:
            self._static_seen = True
            return ""
        return (
            f"{self._pair}: no static position ({seen:.2g} clearances where the sag makes {expected:.2g}); "
            "if the probes are AC-coupled write ac_coupled = true for both, "
            "else correct static_sag_um of the rotor or zero_v of the probes"
        )

    def _slip(self) -> str:
        motions = self._latest
        if len(motions) < _SLIP_REVOLUTIONS:
            return ""
        forward = np.array([motion.forward for motion in motions])
        radius = np.abs(forward)
        sigma = self._sigma(motions[:1])
        if np.ptp(radius) > max(_UNSTEADY * radius.mean(), _SIGNIFICANT * sigma):
            return ""
        parts = forward.reshape(_SLIP_PARTS, -1)
        turns = np.angle([np.vdot(before, after) for before, after in itertools.pairwise(parts)])
        revolutions = parts.shape[1]
        sigma_turn = sigma / float(radius.mean()) / math.sqrt(revolutions)
        slip = float(turns.mean()) / revolutions / math.tau
        # A machine that changes turns its orbit once, within two of the parts at most; a slip goes on.
        lasting = np.abs(turns).min() > 0.4 * np.abs(turns).max() and abs(np.sign(turns).sum()) == len(turns)
        if abs(slip) < _SLIP or not lasting or abs(turns.sum()) < _SIGNIFICANT * sigma_turn:
            return ""
        return (
            f"{self._pair}: the orbit turns {100.0 * abs(slip):.2g} % {'faster' if slip > 0.0 else 'slower'} "
            f"than the pulses of {self._keyphasor}; they do not see the same shaft, or pulses are "
            "miscounted: check the keyphasor's channel and its threshold"
        )


def _unclear_words(pair: str, forward: float, backward: float) -> str:
    return (
        f"{pair}: the orbit does not turn clearly with the shaft (1X radius {forward:.3g} clearances "
        f"forward, {backward:.3g} backward), so the models cannot be compared. Near a critical speed, "
        "supports that are softer in one direction do this: calibrate the rotor by a run-up. Else correct "
        "angle_deg of the probes"
    )


def _radius(parts: Sequence[complex]) -> float:
    return abs(sum(parts)) / len(parts)
