"""Which modes the steady motion after a change excludes, where the model is only nearly the machine's.

The innovations of an observer count every sample as new evidence. But what a model misses is the same in
every revolution: after a hundred of them a lead of thousands of nats may only show which of two wrong
predictions is nearer. So the steady motion is compared as a whole: how far is it from where each fault takes
the machine, compared with the best of them? What the best one misses is the size of the model's error
(it is learnt from the misfit itself), and nothing that is within it may be excluded, or preferred.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from daqsvc.kernels import njit
from daqsvc.rotor import coupled_kernels
from daqsvc.rotor.adaptation import SteadyFit

if TYPE_CHECKING:
    from collections.abc import Collection, Sequence

    from numpy.typing import NDArray

    from daqsvc.rotor.adaptation import SteadyMotion
    from daqsvc.rotor.model import NormalisedRotor

    Complexes = NDArray[np.complex128]
    Flags = NDArray[np.bool_]
    Floats = NDArray[np.float64]
    Observers = NDArray[np.void]
    Couplings = NDArray[np.void]

LEAST_MODEL_ERROR = 0.02
"""Part of a change by which the best model is taken to be off, however well it fits."""
LEAST_REVOLUTIONS = 8
"""Revolutions that a motion has to be steady for."""
_PARTS, _COMPONENTS = 3, 7
"""Of a motion: those that the model may miss, and all with 2X and 3X."""
_NOT_KNOWN = (math.nan,) * (_COMPONENTS - _PARTS)
_EXPLAINS = 0.4
"""Part of a change that a fault may miss and still be taken for its cause."""
_FROM_A_LEVEL = frozenset({"normal", "rub"})
"""What has no size from healthy on: a shaft touches or not."""
_SIGNIFICANT = 2.0
"""Standard deviations of noise that a motion may drift by."""
_LEAST_CHANGE = 0.1
"""Part of the healthy 1X by which that of a healthy machine at its speed does not change."""
_AS_BEFORE = 0.05
"""Part of it within which the machine is as it was."""
_NEARLY = 0.75
"""Part of the mildest load from which on a shaft that rests elsewhere is loaded."""
_NO_MORE = 0.6
"""The same below which it is no more."""
_CERTAIN = 6.0
"""Standard deviations of noise that a change of 1X must have to be one by itself."""
_OFF_ITS_CURVE = 0.25
"""Part of the way that 1X goes while the speed hunts, by which it may be off its curve: it follows late, and
so it did when it was measured."""
_HUNTING = 1.0 + 0.02 * np.linspace(-1.0, 1.0, 9)
"""Parts of the speed that a healthy machine may turn at: it hunts by 1 % while it is calibrated, and now."""
_SETTLING_REV, _STEADY_REV = 60, 10
_SAME_SPEED = 0.02
"""Relative change of speed from which a rub is simulated again: a revolution at many samples takes long."""
_UNSTEADY = 0.1
"""Part of a simulated motion that may change from ten revolutions to the next."""


class SteadyMotions:
    """Where the machine ends in each mode: both senses of 1X, mean position and harmonics, in clearances.

    Args:
        duration: normalised time between samples.
    """

    def __init__(self, duration: float) -> None:
        self._duration = duration
        self._rubs: Complexes = np.empty((0, _COMPONENTS), dtype=np.complex128)
        self._speed = math.nan

    def of(self, observers: Observers, couplings: Couplings) -> Complexes:
        """The motions at the speed of the observers.

        Of a rub the motion is simulated, from the mode's own orbit on, and held while the speed changes
        little. Where it does not become steady, or does not touch, it is NaN.

        Args:
            observers: ``[M]`` of `discretise.OBSERVER`.
            couplings: ``[M]`` of `coupled.COUPLED`.

        Returns:
            complex128 ``[M, 7]``: 1X forward and backward, mean position, and 2X and 3X as 1X.
        """
        rubs, speed = np.flatnonzero(observers["substeps"]), float(observers["speed"][0])
        if not abs(self._speed / speed - 1.0) < _SAME_SPEED:
            simulated = [_of_rub(observers[i], couplings[i], self._duration) for i in rubs]
            self._rubs, self._speed = np.array(simulated).reshape(-1, _COMPONENTS), speed
        motions = np.zeros((len(observers), _COMPONENTS), dtype=np.complex128)
        motions[:, 0] = observers["a"] + 1j * observers["b"]
        motions[:, 1] = couplings["back_a"] + 1j * couplings["back_b"]
        motions[:, 2] = observers["rest_x"] + 1j * observers["rest_y"]
        motions[rubs] = self._rubs
        return motions


def hunting(healthy: NormalisedRotor, speed: float) -> Complexes:
    """Where the healthy machine moves at the speeds about one that it is said to turn at.

    Args:
        healthy: the healthy mode's rotor.
        speed: normalised speed.

    Returns:
        complex128 ``[P, 3]``, the first three components of `SteadyMotions.of`; at the speed itself in the
        middle.
    """
    return np.array([_motion(healthy, w) for w in (speed * _HUNTING).tolist()])


def swing(healthy: NormalisedRotor, slowest: float, fastest: float) -> float:
    """How far the healthy 1X is at one speed from where it is at another, in clearances."""
    moved = np.array(_motion(healthy, fastest)) - np.array(_motion(healthy, slowest))
    return float(np.linalg.norm(moved[:2]))


def _motion(rotor: NormalisedRotor, w: float) -> tuple[complex, complex, complex]:
    return rotor.orbit(w), rotor.backward_orbit(w), rotor.rest


def differs_from(healthy: NormalisedRotor, faulty: NormalisedRotor, speed: float) -> bool:
    """Whether a bank that measured the healthy 1X is certain of a fault by its steady 1X, but for noise.

    Args:
        healthy: the healthy mode's rotor.
        faulty: of a mode that does not touch.
        speed: normalised speed.
    """
    moved = np.array(_motion(faulty, speed)) - np.array(_motion(healthy, speed))
    return SteadyChange(moved, samples=1).is_certain(hunting(healthy, speed), noise=0.0)


def _of_rub(observer: np.void, coupling: np.void, duration: float) -> Complexes:
    turn = float(observer["speed"]) * duration
    per_rev = math.tau / abs(turn)
    count = round((_SETTLING_REV + 2 * _STEADY_REV) * per_rev)
    angle = turn * np.arange(count)
    cos, sin = np.cos(angle), np.sin(angle)
    xy = np.empty((count, 2))
    _move(observer, coupling, cos, sin, xy)
    halves = []
    for begin in (_SETTLING_REV, _SETTLING_REV + _STEADY_REV):
        part = slice(round(begin * per_rev), round((begin + _STEADY_REV) * per_rev))
        fit = SteadyFit()
        fit.add(xy[part], cos[part], sin[part])
        whole = fit.samples == part.stop - part.start
        if not whole or np.hypot(*xy[part].T).max() < 1.0:
            return np.full(_COMPONENTS, np.nan, dtype=np.complex128)
        halves.append(_all_components([fit.solve().with_harmonics(xy[part], cos[part], sin[part])])[0])
    before, after = halves
    if not np.linalg.norm((after - before)[:_PARTS]) <= _UNSTEADY * np.linalg.norm(after[:_PARTS]):
        return np.full(_COMPONENTS, np.nan, dtype=np.complex128)
    return np.asarray((before + after) / 2.0)


def _all_components(motions: Sequence[SteadyMotion]) -> Complexes:
    """Complex128 ``[R, 7]``, as of `SteadyMotions.of`; NaN are the harmonics that are not known."""
    rows = [(one.forward, one.backward, one.rest, *(one.harmonics or _NOT_KNOWN)) for one in motions]
    return np.array(rows, dtype=np.complex128).reshape(-1, _COMPONENTS)


@njit(cache=True, nogil=True, error_model="numpy")
def _move(observer: np.void, coupling: np.void, cos: Floats, sin: Floats, xy: Floats) -> None:
    """Positions of a rotor that is left to itself on its reference orbit, float64 ``[n, 2]``, out."""
    state = (0.0, 0.0, 0.0, 0.0)
    for k in range(len(xy)):
        x, _, y, _ = coupled_kernels.orbit(observer, coupling, cos[k], sin[k])
        xy[k, 0], xy[k, 1] = x + state[0], y + state[2]
        state = coupled_kernels.predict(observer, coupling, cos[k], sin[k], state)


@dataclass(frozen=True, slots=True)
class SteadyChange:
    """How far the motion of some revolutions is from healthy.

    Attributes:
        moved: complex128 ``[3]``, forward and backward 1X and mean position, in clearances; or ``[7]``, with
            the harmonics of `SteadyMotions.of`.
        samples: that it is the mean of.
        variance: float64, of each component of the mean by its scatter, squared clearances; None: not known.
    """

    moved: Complexes
    samples: int
    variance: Floats | None = None

    def is_certain(self, nearby: Complexes, noise: float, swings: float = 0.0) -> bool:
        """Whether no healthy machine moves so, though the observers may see it as well as the healthy one.

        An observer that may err by much follows an orbit that has grown by half, and its innovations hardly
        do. Only 1X counts: the mean position also drifts with the probes. A machine that hunts by a percent
        moves along its own curve of 1X over speed, near a critical speed by as much as a fault does.

        Args:
            nearby: complex128 ``[P, 3]``, where the healthy machine moves about this speed; see `hunting`.
            noise: standard deviation of the measured position, in clearances.
            swings: how far the healthy 1X swings with the speed of late, in clearances; see `swing`.
        """
        healthy = nearby[len(_HUNTING) // 2]
        along = [one[:2] for one in nearby - healthy]
        off = _distance(self.moved[:2], along, beyond=False)
        orbit = float(np.linalg.norm(healthy[:2]))
        least = _LEAST_CHANGE * orbit + _OFF_ITS_CURVE * swings
        return off > max(least, _CERTAIN * noise * math.sqrt(4.0 / self.samples))

    def is_load(self, least: float, noise: float) -> bool:
        """Whether the shaft rests elsewhere by as much as the mildest load moves it, or nearly.

        Probes drift, so how much counts is for who states the loads.

        Args:
            least: how far that load moves it, in clearances; infinite if none is known.
            noise: standard deviation of the measured position, in clearances.
        """
        by_noise = _CERTAIN * noise * math.sqrt(2.0 / self.samples)
        return abs(complex(self.moved[2])) > max(_NEARLY * least, by_noise)

    def is_over(self, healthy: Complexes, least: float = math.inf) -> bool:
        """Whether 1X is that of the healthy machine again, and no load is left.

        Args:
            healthy: complex128 ``[3]`` or ``[7]``, the healthy mode's.
            least: how far the mildest load moves the shaft, in clearances.
        """
        moved, orbit = (float(np.linalg.norm(one[:2])) for one in (self.moved, healthy))
        return moved < _AS_BEFORE * orbit and abs(complex(self.moved[2])) < _NO_MORE * least


def steady_change(motions: Sequence[SteadyMotion], healthy: Complexes, noise: float) -> SteadyChange | None:
    """The change over as many of the last revolutions as it has been steady for; None while it still moves.

    Args:
        motions: of whole revolutions, the oldest first.
        healthy: complex128 ``[3]`` or, with harmonics, ``[7]``, the healthy mode's.
        noise: standard deviation of the measured position, in clearances.
    """
    counts: list[int] = []
    while (count := len(motions) >> len(counts)) >= LEAST_REVOLUTIONS:
        counts.append(count)
    if not counts:
        return None
    whole = _all_components(motions)[:, : len(healthy)] - healthy
    sizes = np.array([one.samples for one in motions])
    found = None
    # From the fewest on: of many, the halves may agree though the machine went and came back.
    for count in reversed(counts):
        parts, samples = whole[-count:], int(sizes[-count:].sum())
        moved = parts.mean(axis=0)
        drift = (parts[count // 2 :].mean(axis=0) - parts[: count // 2].mean(axis=0))[:_PARTS]
        # The mean of half the samples has a variance of 4 noise^2 / samples in each of its parts.
        by_noise = _SIGNIFICANT * noise * math.sqrt(8.0 * _PARTS / samples)
        if not np.linalg.norm(drift) <= max(_UNSTEADY * float(np.linalg.norm(moved[:_PARTS])), by_noise):
            break
        found = SteadyChange(moved, samples, _of_mean(parts, samples, noise))
    return found


def steady_baseline(motions: Sequence[SteadyMotion], noise: float) -> tuple[Complexes, Floats] | None:
    """Mean of a healthy machine's motions, and the variance of it.

    Args:
        motions: of whole revolutions.
        noise: standard deviation of the measured position, in clearances.

    Returns:
        complex128 and float64 ``[7]``, in clearances and their square; None where harmonics are not known.
    """
    parts = _all_components(motions)
    parts = parts[np.isfinite(parts).all(axis=1)]
    if len(parts) < LEAST_REVOLUTIONS:
        return None
    samples = sum(one.samples for one in motions if one.harmonics is not None)
    return parts.mean(axis=0), _of_mean(parts, samples, noise)


def _of_mean(parts: Complexes, samples: int, noise: float) -> Floats:
    """Variance of a mean of motions: by the noise, or by their scatter, if that is more."""
    scatter = np.var(parts, axis=0) / (len(parts) - 1)
    return np.asarray(np.maximum(2.0 * noise**2 / samples, scatter))


@dataclass(frozen=True, slots=True)
class Misfit:
    """How the modes miss a steady change.

    Attributes:
        part: float64 ``[M]``, of the change that each mode's fault does not explain; NaN where not known.
        excluded: bool ``[M]``, modes that are too far behind the best one.
        pairs: bool ``[M, M]``, modes of different faults that the model's error alone does not tell apart.
            The noise is left out of this: it is in the evidence of the observers. The healthy mode is in no
            pair, as the machine has changed.
    """

    part: Floats
    excluded: Flags
    pairs: Flags


def misfit(
    change: SteadyChange,
    motions: Complexes,
    faults: Sequence[str],
    *,
    noise: float,
    nats: float,
    exact: Collection[str] = (),
) -> Misfit:
    """How far a steady change is from where each fault takes the machine.

    A fault may have any size from healthy on, also beyond its worst mode; a rub only between its modes. So
    all levels of a fault miss it by the same. What the best one misses is the model's error, learnt.

    Args:
        change: the change.
        motions: complex128 ``[M, 7]``, of `SteadyMotions`; the first is healthy. Harmonics have no part in
            this: they show contact, and not how well the model knows the machine.
        faults: ``[M]``, what each mode is called: ``"normal"``, ``"rub"``, ...
        noise: standard deviation of the measured position, in clearances.
        nats: evidence behind the best fault from which a fault is excluded, and below which it is not told
            apart.
        exact: faults of which the model knows where they take the machine, whatever else it misses: on
            springs, a load moves no 1X. They have no part in its error.
    """
    levels: dict[str, list[Complexes]] = {}
    moved = change.moved[:_PARTS]
    for fault, motion in zip(faults, (motions - motions[0])[:, :_PARTS], strict=True):
        levels.setdefault(fault, [] if fault in _FROM_A_LEVEL else [np.zeros(_PARTS, complex)]).append(motion)
    off = {
        fault: _distance(moved, points, beyond=fault not in _FROM_A_LEVEL) for fault, points in levels.items()
    }
    missed = np.array([off[fault] for fault in faults])
    size = float(np.linalg.norm(moved))
    by_noise, least = 2.0 * noise**2 / change.samples, (LEAST_MODEL_ERROR * size) ** 2
    wrong = np.isin(faults, list(exact)) & (missed**2 > 2.0 * nats * (least + by_noise))
    rest = np.where(wrong, np.nan, missed**2)
    best = float(np.nanmin(rest))
    by_model = max(least, best / _PARTS - by_noise)
    if best > (_EXPLAINS * size) ** 2:  # no fault takes the machine there: which one is nearest means nothing
        by_model = size**2
    behind = rest - best
    close = behind < 2.0 * nats * by_model
    close[0] = False
    named = np.array(faults)
    return Misfit(
        part=missed / size,
        excluded=wrong | (behind > 2.0 * nats * (by_model + by_noise)),
        pairs=np.logical_and.outer(close, close) & (named[:, np.newaxis] != named),
    )


def _distance(change: Complexes, points: Sequence[Complexes], *, beyond: bool) -> float:
    """From a change to the nearest point of a line through the levels of a fault.

    Args:
        change: the change.
        points: where the levels are.
        beyond: whether the line goes on behind the last of them.
    """
    if len(points) == 1:
        return float(np.linalg.norm(change - points[0]))
    nearest, last = math.inf, len(points) - 2
    for k, (begin, end) in enumerate(itertools.pairwise(points)):
        along, to = end - begin, change - begin
        length = float(np.vdot(along, along).real)
        part = float(np.vdot(along, to).real) / length if length > 0.0 else 0.0
        part = max(0.0, part if beyond and k == last else min(1.0, part))
        nearest = min(nearest, float(np.linalg.norm(to - part * along)))
    return nearest if nearest < math.inf else math.nan
