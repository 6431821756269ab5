"""What each fault does to the synchronous vector, as a likelihood.

Given the change d of the synchronous vector since the healthy baseline and the variance v of each of its
components, every hypothesis has a marginal likelihood. Its unknown amplitude, direction and the box of the
rotor's parameters are averaged over, so that a flexible hypothesis pays for its flexibility. All in nats.

* unbalance: only 1X moves, anyhow; damping loss: only 1X moves, and along what less damping does to it.
* static load: only the mean position moves; on a machine that is no Laval rotor, 1X may follow it a little.
* stiffness loss: mean position and 1X move together, by one parameter. On a machine that is no Laval rotor
  the shaft sinks, and 1X turns by about as much as the natural frequency has moved, or by any amount.
* rub: a pulse once a revolution, directed inwards where the orbit comes nearest to the wall, passed through
  the rotor (`daqsvc.rotor.synchronous.pulses`), with marks of contact (`daqsvc.rotor.synchronous.contact`);
  or an orbit that fills the clearance.
* unmodelled: any components, each by itself. It pays `UNMODELLED_NATS` for explaining everything.

Where a run-up has shown the rotor's two modes, they show how damping loss and stiffness loss move the vector,
and on oil films a load (`daqsvc.rotor.synchronous.by_two_modes`). The free shapes above are for what few
machines do beside that. Where it is stated that no oil film carries the shaft, a load moves no 1X.

From the likelihoods follows the name or the group of names (`identify`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal, NamedTuple, TypeAlias, get_args

import numpy as np

from daqsvc.rotor.laval import unbalance_response
from daqsvc.rotor.synchronous.by_two_modes import less_damped, loaded, on_film, softer
from daqsvc.rotor.synchronous.contact import (
    fills_clearance,
    has_marks,
    marks_would_show,
    moves_besides,
    resolved,
)
from daqsvc.rotor.synchronous.pulses import crack, rub_pulse
from daqsvc.rotor.synchronous.vectors import (
    BACKWARD,
    BEYOND_1X,
    DC,
    FORWARD,
    SPREADS,
    Healthy,
    density,
    log_density,
    log_mean,
)

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from daqsvc.rotor.laval import LavalRotor
    from daqsvc.rotor.synchronous.baseline import Calibration
    from daqsvc.rotor.synchronous.nonsynchronous import NonsynchronousLine
    from daqsvc.rotor.synchronous.transient import Comparison

    Complexes = NDArray[np.complex128]
    Floats = NDArray[np.float64]


RotorFault: TypeAlias = Literal[
    "normal",
    "unbalance",
    "damping_loss",
    "static_load",
    "stiffness_loss",
    "rub",
    "unmodelled",
    "small_change",
]
"""Verdicts about a rotor."""
FAULTS: tuple[RotorFault, ...] = get_args(RotorFault)

UNMODELLED_NATS = 6.0

_LEAK = 0.01
"""What a change of one component may leave in the others: the machine is not exactly a Laval rotor."""

_STIFFNESS_LOSSES = np.geomspace(0.02, 1.2, 24)
"""1 / k - 1 of the stiffness losses looked for."""
_STIFFNESS_TOLERANCE = 0.3
_FOLLOWS = np.array([0.1, 0.3])
"""Parts of a shift by which 1X may follow it where supports are stiffer the more they carry."""
_FOLLOWING_NATS = 3.0
_SHIFTS = np.geomspace(0.1, 10.0, 24)
"""Ways that a load from an expected direction moves the shaft, in parts of the healthy orbit."""
_FROM_ELSEWHERE = 0.2
"""Probability that a load comes from another direction than the expected ones."""
_SINKS = np.geomspace(0.02, 1.5, 12)
"""Parts of the sag that a shaft sinks by where no model gives how much of it is due to the softer part ..."""
_SINKS_ASIDE = np.radians([-50.0, -25.0, 0.0, 25.0, 50.0])
"""... and angles off the vertical: an oil film gives way aside, too."""
_SINKS_WITHIN = 0.25
_SEEN_OF_SINK = np.array([0.5, 1.0, 2.0])
"""Loss of the natural frequency's square over what the probes see the shaft sink by, as parts of each."""
_TURNS_WITHIN = 0.4
_STILL_SHARE = 0.2
"""Probability that 1X does not follow a softer support, as far above the critical speed."""
_STIFFNESS_DAMPING = np.array([0.0, 1.8])
"""A softer support also damps more: relative increase per 1 / k - 1, up to `_MOST_DAMPING`."""
_MOST_DAMPING = 1.6

_BESIDES = 0.02
"""Probability that a fault moves a rotor in another way than its two modes predict."""

_FIRST_MODE = 0.1
"""Largest probability that less damping moves 1X as that of a Laval rotor, whatever the two modes predict.
It is no larger than what modes beyond the run-up take of the static deflection."""

_NO_CONTACT_NATS = 12.0
"""Nats by which a rub is put behind all others where its harmonics would be seen and are not."""
_HIDDEN_CONTACT_NATS = 1.0
"""The same where noise may hide them: a rub stays in the group, but is not the first of it."""

_DAMPING_LEFT = np.geomspace(0.03, 0.97, 40)
_DAMPING_FREQUENCY = np.array([0.92, 0.96, 1.0, 1.015])
_DAMPING_MASS = np.array([0.86, 0.93, 1.0, 1.02])
_DAMPING_TOLERANCE = 0.05
"""Less damping in a bearing shifts frequency and modal mass with it (independent rotor code)."""


def likelihoods(
    change: Complexes, variance: Floats, healthy: Healthy, position: Complexes, *, shaken: bool = False
) -> dict[RotorFault, float]:
    """Log marginal likelihood ratio of every hypothesis against "normal", in nats.

    Args:
        change: complex128 ``[5]`` or, with 3X, ``[7]``, d in um, in the order of `WITH_THRICE`.
        variance: float64, as many, complex variance of each component of it, um^2.
        healthy: the machine before.
        position: complex128 ``[5]``, the present synchronous vector in um, for the clearance.
        shaken: whether motion came with the change that does not repeat with the shaft.
    """
    scores = linear_faults(change, variance, healthy)
    normal = scores["normal"]
    scores["unmodelled"] = unmodelled(change, variance, healthy)
    scores["rub"], behind = _rub(change, variance, healthy, position, shaken=shaken)
    if behind:
        scores["rub"] = min(scores["rub"], max(scores[name] for name in scores.keys() - {"rub"}) - behind)
    # In the order of the names: ties go to the first.
    return {name: scores[name] - normal for name in FAULTS if name in scores}


def linear_faults(
    change: Complexes, variance: Floats, healthy: Healthy, *, load_towards: Complexes | None = None
) -> dict[RotorFault, float]:
    """Log marginal likelihood of no fault, and of each that leaves the rotor linear, in nats.

    Args:
        change: complex128 ``[5]`` or, with 3X, ``[7]``, um.
        variance: float64, as many, um^2.
        healthy: the machine before.
        load_towards: complex128 ``[L]``, unit vectors along which static loads are expected to move the
            shaft; None: any direction is as likely.
    """
    half = math.log(0.5)
    return {
        "normal": float(log_density(change, variance).sum()),
        "unbalance": _unbalance(change, variance, healthy) + half,
        "damping_loss": _damping_loss(change, variance, healthy) + half,
        "static_load": _static_load(change, variance, healthy, load_towards),
        "stiffness_loss": _stiffness_loss(change, variance, healthy),
    }


def unmodelled(change: Complexes, variance: Floats, healthy: Healthy) -> float:
    """Log marginal likelihood of a change that no fault explains, or a crack alone, in nats.

    Args:
        change: complex128 ``[5]`` or, with 3X, ``[7]``, um.
        variance: float64, as many, um^2.
        healthy: the machine before.
    """
    free = anything(change, variance, healthy) - UNMODELLED_NATS
    return float(np.logaddexp(free, crack(change, variance, healthy) - 1.0))


def damping_misfit(change: Complexes, variance: Floats, healthy: Healthy) -> float:
    """How far the change of 1X lies from all that a loss of damping can do, in nats; 0 if it can do it.

    The nearest point decides, not the average: what cannot be told apart must stay in the group.
    """
    before, after = _damped(healthy)
    forward = healthy.baseline[FORWARD]
    moved = forward * (after / before - 1.0)
    tolerance = _DAMPING_TOLERANCE * abs(forward + change[FORWARD])
    misfit = np.abs(change[FORWARD] - moved) ** 2 / (variance[FORWARD] + tolerance**2)
    return float(max(0.0, misfit.min() - 1.0))


def _still(change: Complexes, variance: Floats, moved: float) -> Floats:
    """Log density of components that do not move, but for a leak from those that do."""
    return np.logaddexp(
        log_density(change, variance), log_density(change, variance + (_LEAK * moved) ** 2)
    ) - math.log(2.0)


def _free(change: complex, variance: float, amplitude: float) -> float:
    """Log density of a component that moves by an amount not known."""
    return log_mean(log_density(np.full(4, change), variance + (SPREADS * amplitude) ** 2))


def _unbalance(change: Complexes, variance: Floats, healthy: Healthy) -> float:
    """1X moves, and on an elliptic orbit backward 1X with it: by as much, if the plane is the same."""
    moved = abs(change[FORWARD])
    score = _still(change, variance, moved)
    forward, backward = healthy.baseline[FORWARD], healthy.baseline[BACKWARD]
    in_plane = np.conj(change[FORWARD] / forward) * backward
    near = (0.1 * abs(in_plane)) ** 2 + (_LEAK * moved) ** 2
    wide = (1.5 * healthy.ellipticity * moved) ** 2 + (_LEAK * moved) ** 2
    score[BACKWARD] = np.logaddexp.reduce(
        [
            score[BACKWARD],
            density(change[BACKWARD] - in_plane, variance[BACKWARD] + near),
            density(change[BACKWARD], variance[BACKWARD] + wide),
        ]
    ) - math.log(3.0)
    score[FORWARD] = _free(change[FORWARD], variance[FORWARD], healthy.amplitude_um)
    return float(score.sum())


def _besides(predicted: float, free: float) -> float:
    """Log likelihood of what the two modes predict, and of a shape that leaves open what they do not."""
    return float(np.logaddexp(predicted + math.log1p(-_BESIDES), free + math.log(_BESIDES)))


def _damping_loss(change: Complexes, variance: Floats, healthy: Healthy) -> float:
    free = _free_damping_loss(change, variance, healthy)
    rotor = healthy.rotor.two_modes
    if rotor is None:
        return free
    moved = float(np.abs(change[[FORWARD, BACKWARD]]).max())
    rest = float(_still(change, variance, moved)[BEYOND_1X].sum())
    predicted = _besides(rest + less_damped(change, variance, healthy, rotor), free)
    beyond = 0.0 if rotor.two_modes is None else abs(rotor.two_modes.higher_modes)
    if not beyond:
        return predicted
    # Modes beyond the run-up hide which damper damps what: it may be the first mode that has lost damping.
    first_mode = _unbalance(change, variance, healthy) - damping_misfit(change, variance, healthy)
    return float(np.logaddexp(predicted, first_mode + math.log(min(_FIRST_MODE, beyond))))


def _free_damping_loss(change: Complexes, variance: Floats, healthy: Healthy) -> float:
    """1X moves as less damping moves it; where the rotor is no Laval rotor, both senses of 1X move anyhow."""
    if healthy.laval:
        return _unbalance(change, variance, healthy) - damping_misfit(change, variance, healthy)
    both = [FORWARD, BACKWARD]
    score = _still(change, variance, float(np.abs(change[both]).max()))
    for k in both:
        score[k] = _free(change[k], variance[k], healthy.amplitude_um)
    return float(score.sum()) - _beyond_reach(change, variance, healthy)


def _beyond_reach(change: Complexes, variance: Floats, healthy: Healthy) -> float:
    """How much further 1X moves than a loss of damping can move it, in nats, whatever the rotor's shape.

    The direction of the change is that of a Laval rotor only; its size is no larger for any mode that has
    the stated frequency and damping.
    """
    before, after = _damped(healthy)
    reach = float(np.abs(after / before - 1.0).max()) * healthy.whirl_um
    moved = float(np.hypot(abs(change[FORWARD]), abs(change[BACKWARD])))
    tolerance = (_DAMPING_TOLERANCE * moved) ** 2 + float(variance[FORWARD] + variance[BACKWARD])
    return max(0.0, max(0.0, moved - reach) ** 2 / tolerance - 1.0)


def _damped(healthy: Healthy) -> tuple[Complexes, Complexes]:
    """1X response before and after every loss of damping, complex128 ``[n]`` each."""
    omega, zeta = healthy.rotor.box
    speed = healthy.speed_rad_s
    grid = np.meshgrid(np.arange(len(omega)), _DAMPING_LEFT, _DAMPING_FREQUENCY, _DAMPING_MASS, indexing="ij")
    point, left, frequency, mass = (axis.ravel() for axis in grid)
    point = point.astype(np.int64)
    before = unbalance_response(speed / omega[point], zeta[point])
    return before, mass * unbalance_response(speed / (omega[point] * frequency), zeta[point] * left)


def _static_load(change: Complexes, variance: Floats, healthy: Healthy, towards: Complexes | None) -> float:
    free = _free_static_load(change, variance, healthy, towards)
    rotor = healthy.rotor.two_modes
    if rotor is None or not on_film(healthy.rotor):
        return free
    rest = _still(change, variance, abs(change[DC]))
    predicted = float(rest[BEYOND_1X].sum()) + _shifted(change[DC], variance[DC], healthy, towards)
    return _besides(predicted + loaded(change, variance, healthy, rotor), free)


def _shifted(change: complex, variance: float, healthy: Healthy, towards: Complexes | None) -> float:
    """Log density of the mean position under a static load, from anywhere or from where it is expected."""
    free = _free(change, variance, healthy.amplitude_um)
    if towards is None or not len(towards):
        return free
    shifts = np.outer(_SHIFTS * healthy.amplitude_um, towards).ravel()
    expected = log_mean(log_density(change - shifts, variance + (_SINKS_WITHIN * np.abs(shifts)) ** 2))
    return float(np.logaddexp(expected + math.log1p(-_FROM_ELSEWHERE), free + math.log(_FROM_ELSEWHERE)))


def _free_static_load(
    change: Complexes, variance: Floats, healthy: Healthy, towards: Complexes | None
) -> float:
    score = _still(change, variance, abs(change[DC]))
    score[DC] = _shifted(change[DC], variance[DC], healthy, towards)
    if not healthy.laval and healthy.rotor.plain_bearings is not False:
        # An oil film that carries more is stiffer: the orbit follows, by a part of the shaft's way.
        way = min(abs(change[DC]), healthy.amplitude_um)
        for k in (FORWARD, BACKWARD):
            follows = log_density(np.full(2, change[k]), variance[k] + (_FOLLOWS * way) ** 2)
            score[k] = np.logaddexp(score[k], log_mean(follows) - _FOLLOWING_NATS)
    return float(score.sum())


def _sunk(change: complex, variance: float, healthy: Healthy) -> float:
    """Log density of the mean position where some unknown support gives way under the weight."""
    sag_um = max(healthy.rotor.sag_um, 1e-6)
    depth, aside = np.meshgrid(_SINKS, _SINKS_ASIDE, indexing="ij")
    moved: Complexes = np.asarray(-1j * sag_um * depth * np.exp(1j * aside), dtype=np.complex128).ravel()
    return log_mean(log_density(change - moved, variance + (_SINKS_WITHIN * np.abs(moved)) ** 2))


def _softer(change: Complexes, variance: Floats, healthy: Healthy, *, still: float) -> float:
    """Log density of mean position and forward 1X where some support gives way under the weight.

    How far the shaft sinks shows how much lower its natural frequency is, up to the part that the probes see
    of it (Rayleigh's quotient, omega^2 = g over the sag). That shows how 1X turns. Or 1X moves in any way.
    """
    free = _free(change[FORWARD], variance[FORWARD], healthy.amplitude_um)
    if healthy.rotor.two_modes is None:
        free = np.logaddexp(still + math.log(_STILL_SHARE), free + math.log(1.0 - _STILL_SHARE))
    # else the modes show where 1X stays as it is
    untied = _sunk(change[DC], variance[DC], healthy) + free
    sag_um = healthy.rotor.sag_um
    if sag_um <= 0.0:
        return float(untied)  # an upright shaft: nothing sinks that could explain 1X
    omega, zeta = (axis.reshape(5, 5)[::2, ::2].ravel() for axis in healthy.rotor.box)
    depth, aside, part, point = (
        axis.ravel()
        for axis in np.meshgrid(_SINKS, _SINKS_ASIDE, _SEEN_OF_SINK, np.arange(len(omega)), indexing="ij")
    )
    point = point.astype(np.int64)
    speed = healthy.speed_rad_s / omega[point]
    sunk: Complexes = np.asarray(-1j * sag_um * depth * np.exp(1j * aside), dtype=np.complex128)
    softer = speed * np.sqrt(1.0 + depth * part)
    before, after = unbalance_response(speed, zeta[point]), unbalance_response(softer, zeta[point])
    # The eccentricity stays: the response in units of it is what changes.
    turned = healthy.baseline[FORWARD] * (after / before - 1.0)
    tied = log_mean(
        log_density(change[DC] - sunk, variance[DC] + (_SINKS_WITHIN * np.abs(sunk)) ** 2)
        + log_density(change[FORWARD] - turned, variance[FORWARD] + (_TURNS_WITHIN * np.abs(turned)) ** 2)
    )
    return float(np.logaddexp(tied, untied)) - math.log(2.0)


def _stiffness_loss(change: Complexes, variance: Floats, healthy: Healthy) -> float:
    free = _free_stiffness_loss(change, variance, healthy)
    rotor = healthy.rotor.two_modes
    if rotor is None:
        return free
    moved = float(np.hypot(abs(change[DC]), abs(change[FORWARD])))
    rest = float(_still(change, variance, moved)[BEYOND_1X].sum())
    return _besides(rest + softer(change, variance, healthy, rotor), free)


def _free_stiffness_loss(change: Complexes, variance: Floats, healthy: Healthy) -> float:
    moved = float(np.hypot(abs(change[DC]), abs(change[FORWARD])))
    score = _still(change, variance, moved)
    rest = float(score.sum() - score[DC] - score[FORWARD])
    if not healthy.laval:
        # A support that gives way makes the orbit rounder or flatter, too.
        backward = np.logaddexp(
            score[BACKWARD], _free(change[BACKWARD], variance[BACKWARD], healthy.amplitude_um)
        ) - math.log(2.0)
        softer = _softer(change, variance, healthy, still=float(score[FORWARD]))
        return rest - float(score[BACKWARD]) + float(backward) + softer
    omega, zeta = healthy.rotor.box
    loss, point, more = (
        axis.ravel()
        for axis in np.meshgrid(_STIFFNESS_LOSSES, np.arange(len(omega)), _STIFFNESS_DAMPING, indexing="ij")
    )
    point = point.astype(np.int64)
    stiffness = 1.0 / (1.0 + loss)
    factor = np.minimum(1.0 + more * loss, _MOST_DAMPING)
    speed = healthy.speed_rad_s / omega[point]
    before = 1.0 / (1.0 - speed**2 + 2j * zeta[point] * speed)
    after = 1.0 / (stiffness - speed**2 + 2j * zeta[point] * factor * speed)
    sag_um = healthy.rotor.sag_um * (healthy.rotor.natural_frequency_rad_s / omega[point]) ** 2
    predicted = (-1j * loss * sag_um, healthy.baseline[FORWARD] * (after / before - 1.0))
    total = np.zeros(len(loss))
    for component, moved_by in zip((DC, FORWARD), predicted, strict=True):
        spread = variance[component] + (_STIFFNESS_TOLERANCE * np.abs(moved_by)) ** 2
        total += log_density(change[component] - moved_by, spread)
    return rest + log_mean(total)


def _rub(
    change: Complexes, variance: Floats, healthy: Healthy, position: Complexes, *, shaken: bool
) -> tuple[float, float]:
    """Likelihood of a rub, and nats that it stays behind all others where no mark of contact shows."""
    pulse = rub_pulse(change, variance, healthy, position)
    if fills_clearance(position, change, variance, healthy):
        # An orbit that fills the clearance touches, whatever shape it has by then.
        return max(pulse, anything(change, variance, healthy) + UNMODELLED_NATS), 0.0
    if shaken or has_marks(change, variance):
        return pulse, 0.0
    alone = resolved(variance, healthy)
    if marks_would_show(change, alone) and not has_marks(change, alone):
        return pulse, _NO_CONTACT_NATS
    # Where the rotor's model holds, it gives how a pulse moves the mean position and both senses of 1X.
    predicted = healthy.modelled and moves_besides(change, variance, healthy)
    return pulse, 0.0 if predicted else _HIDDEN_CONTACT_NATS


def anything(change: Complexes, variance: Floats, healthy: Healthy) -> float:
    """Log marginal likelihood of a change of which every component moves by itself, or not at all.

    Args:
        change: complex128 ``[5]`` or, with 3X, ``[7]``, um.
        variance: float64, as many, um^2.
        healthy: the machine before.
    """
    moved = float(np.abs(change).max())
    still = _still(change, variance, moved)
    total = 0.0
    for k in range(len(change)):
        total += np.logaddexp(still[k], _free(change[k], variance[k], healthy.amplitude_um)) - math.log(2.0)
    return float(total)


_GENERIC_RUB_MARGIN_NATS = 12.0
_ENERGY_NATS = 12.0
_ALL_OF_IT = 0.9
"""Part of the energy of a line that is taken for all of it."""
_MOST_ENERGY_NATS = 100.0
_MISFIT = 0.005
"""Part of the evidence of a change that the shape of a rub's pulse may be off by: where no rotor model fits
exactly, a few nats of thousands mean nothing."""
_UNMARKED_RUB_MARGIN_NATS = 2.0
"""A rub that leaves no mark of contact is rare, even where noise may hide one. So what explains a change of
1X alone leaves it out of the group sooner, if a model tells how the pulse of a rub would move the machine."""
_ONLY_1X = frozenset(("unbalance", "damping_loss"))
_RIVALS = frozenset(("rub", "unmodelled"))
TEMPERATURE = 3.0
"""What evidence is divided by before it is a probability: no machine follows a signature exactly, so
likelihoods are too certain. Of finite-element rotors this value makes what is true likeliest (the
best of each geometry and noise lies from 2 to 5); one that grows with the evidence does worse."""


@dataclass(frozen=True, slots=True, kw_only=True)
class NamingRules:
    """Margins of a name.

    Attributes:
        margin_nats: lead over every other hypothesis that a name takes: odds of 5 to 1, `TEMPERATURE` taken
            off.
        rub_margin_nats: lead of rub over "unmodelled": a crack at half speed looks much like a rub.
        least_severity: part of the healthy whirl below which a change is small and gets no name.
    """

    margin_nats: float = 5.0
    rub_margin_nats: float = 5.0
    least_severity: float = 0.05


NAMED_BY_RUN_UP = NamingRules(margin_nats=3.5, rub_margin_nats=3.5)
"""Where a run-up has shown the rotor's two modes, odds of 3 to 1 are enough. Of finite-element rotors no more
than 1 % of the faults get a wrong name then, as with 5 nats, and fewer stay in a group."""


def naming_of(rotor: LavalRotor) -> NamingRules:
    """The margins of a name, by what is known of the rotor."""
    return NamingRules() if rotor.two_modes is None else NAMED_BY_RUN_UP


@dataclass(frozen=True, slots=True)
class Energy:
    """What the non-harmonic energy shows of a segment.

    Attributes:
        excess: variance of the complex residual of a sample above the healthy one, um^2.
        nats: evidence that it is more than chance.
    """

    excess: float = 0.0
    nats: float = 0.0


@dataclass(frozen=True, slots=True)
class Identification:
    """What a change of the synchronous vector is.

    Attributes:
        verdict: the name, or the most likely member of the group.
        group: all that cannot be told apart, the most likely first; the verdict alone if there is no other.
        named: whether two evaluations in a row agreed on the group.
        evidence: nats of every hypothesis over "normal".
        probabilities: posterior of every verdict, hypotheses equally likely before.
        change: complex128 ``[5]``, d in um.
        severity: size of the change, its non-harmonic energy included, over the healthy whirl's amplitude.
        excess: variance of a complex sample that does not repeat with the shaft, above the healthy one, um^2.
        candidates: verdict and group of this evaluation alone.
        line: that came with the change beside the harmonics of the shaft; None if none stands out.
        by_line: whether this line is what has changed.
    """

    verdict: RotorFault
    group: tuple[RotorFault, ...]
    named: bool
    evidence: Mapping[RotorFault, float]
    probabilities: Mapping[RotorFault, float]
    change: Complexes
    severity: float
    candidates: tuple[RotorFault, ...] = field(default=())
    excess: float = 0.0
    line: NonsynchronousLine | None = None
    by_line: bool = False

    def describe_line(self) -> str:
        """One sentence about the line; empty if there is none."""
        if self.line is None:
            return ""
        return self.line.describe() + ("; no fault of the rotor" if self.by_line else "")


class WithoutLine(NamedTuple):
    """The change of the harmonics without a line that beats with one of them.

    Attributes:
        change: complex128 ``[5]``, um.
        variance: float64 ``[5]``, um^2.
    """

    change: Complexes
    variance: Floats


def identify(
    change: Complexes,
    variance: Floats,
    healthy: Calibration,
    *,
    previous: Identification | None,
    rules: NamingRules,
    may_name: bool = True,
    comparison: Comparison | None = None,
    energy: Energy | None = None,
    line: NonsynchronousLine | None = None,
    rest: WithoutLine | None = None,
) -> Identification:
    """Weigh the hypotheses.

    Args:
        change: complex128 ``[5]`` or, with 3X, ``[7]``, mean synchronous vector of the present segment less
            the baseline, um.
        variance: float64, as many, its variance, um^2.
        healthy: the baseline.
        previous: the evaluation before; a name takes two that agree.
        rules: margins.
        may_name: whether the rotor has settled enough for a name.
        comparison: what the transient shows of unbalance and loss of damping, if it was abrupt.
        energy: of the present segment; motion that does not repeat with the shaft (whirl, repeated
            impacts) is what no linear fault makes.
        line: that came with the change beside the harmonics.
        rest: what the change is without it, where it beats with a harmonic. Where nothing is left, the line
            is what has changed, and no fault of the rotor.
    """
    amplitude = healthy.healthy.amplitude_um
    least = (rules.least_severity * amplitude) ** 2
    energy = _without(energy, line)
    if rest is not None and line is not None and (line.modulates is None or _is_still(rest, healthy, rules)):
        change, variance = rest
    shaken = energy is not None and energy.nats > _ENERGY_NATS and energy.excess > least
    position = healthy.baseline + change[: len(healthy.baseline)]
    scores = likelihoods(change, variance, healthy.healthy, position, shaken=shaken)
    # 3X shows what a change is, not how large it is.
    change, variance = change[: len(healthy.baseline)], variance[: len(healthy.baseline)]
    model_holds = comparison is not None and comparison.holds(complex(change[1]))
    if comparison is not None and model_holds:
        scores["damping_loss"] += min(0.0, comparison.damping_nats)
        scores["unbalance"] += min(0.0, -comparison.damping_nats)
    square = float(np.sum(np.abs(change) ** 2))
    if energy is not None and shaken:
        square += energy.excess
        unexplained = min(energy.nats, _MOST_ENERGY_NATS)
        # A rub also shakes the rotor; but what leaves no mark of a rub on the vector is noise or whirl.
        explained = {"unmodelled"} if scores["rub"] < rules.margin_nats else {"unmodelled", "rub"}
        for name in scores.keys() - explained:
            scores[name] -= unexplained
    size = math.sqrt(square)
    # The typical component: that of the mean position may be drift of the probes, or not there at all.
    deviation = math.sqrt(float(np.median(variance)))
    best = max(scores, key=lambda name: scores[name])
    excess = energy.excess if energy is not None and energy.nats > _ENERGY_NATS else 0.0
    is_small = size < rules.least_severity * amplitude + 2.0 * deviation
    by_line = line is not None and line.is_foreign and (best == "normal" or is_small)
    if line is not None:
        excess = max(excess, line.amplitude_um**2)
    if line is not None and by_line:
        scores = {name: min(nats, scores["unmodelled"] - _MOST_ENERGY_NATS) for name, nats in scores.items()}
        scores["unmodelled"] += _MOST_ENERGY_NATS
        best, size = "unmodelled", max(size, line.amplitude_um)
        is_small = size < rules.least_severity * amplitude + 2.0 * deviation
    probabilities = posterior(scores)
    candidates: tuple[RotorFault, ...]
    if best != "normal" and is_small:
        candidates = ("small_change",)
        probabilities = {"normal": probabilities["normal"], "small_change": 1.0 - probabilities["normal"]}
    elif by_line:
        candidates = ("unmodelled",)
    else:
        marked = shaken or has_marks(change, variance)
        candidates = _group(scores, best, healthy, rules, marked=marked)
    agreed = by_line or (
        previous is not None
        and (
            set(previous.candidates) == set(candidates)
            or (model_holds and set(candidates) < set(previous.candidates))
        )
    )
    # That the machine may be healthy again is for the watch to decide; until then a name is kept.
    named = may_name and agreed and "normal" not in candidates
    group = candidates
    if previous is not None and previous.named and not named:
        # One evaluation does not remove a name, nor what is stated with it.
        group, probabilities = previous.group, dict(previous.probabilities)
        named = True
    return Identification(
        verdict=group[0],
        group=group,
        named=named,
        evidence=scores,
        probabilities=probabilities,
        change=change,
        severity=size / max(amplitude, 1e-12),
        candidates=candidates,
        excess=excess,
        line=line,
        by_line=by_line,
    )


def _without(energy: Energy | None, line: NonsynchronousLine | None) -> Energy | None:
    """The energy that no line makes which is none of the rotor's."""
    if energy is None or energy.excess <= 0.0 or line is None or not line.is_foreign:
        return energy
    left = 1.0 - line.share if line.share < _ALL_OF_IT else 0.0
    return Energy(energy.excess * left, energy.nats * left**2)


def _is_still(rest: WithoutLine, healthy: Calibration, rules: NamingRules) -> bool:
    """Whether nothing that would get a name has changed beside a line."""
    scores = likelihoods(rest.change, rest.variance, healthy.healthy, healthy.baseline + rest.change)
    least = rules.least_severity * healthy.healthy.amplitude_um
    small = float(np.linalg.norm(rest.change)) < least + 2.0 * math.sqrt(float(np.median(rest.variance)))
    return small or max(scores.values()) <= scores["normal"]


def _group(
    scores: Mapping[RotorFault, float],
    best: RotorFault,
    healthy: Calibration,
    rules: NamingRules,
    *,
    marked: bool,
) -> tuple[RotorFault, ...]:
    """All hypotheses within the margin of the best one, the best first; `marked`: by marks of contact."""
    # Without a model any change of both senses of 1X would be a loss of damping.
    alone = best == "damping_loss" and scores[best] - scores["unbalance"] > rules.margin_nats

    def margin(name: RotorFault) -> float:
        if name == "unmodelled" and alone and not healthy.healthy.modelled:
            return math.inf
        if {name, best} == _RIVALS:
            return rules.rub_margin_nats if healthy.healthy.modelled else _GENERIC_RUB_MARGIN_NATS
        if name == "rub" and best in _ONLY_1X and healthy.healthy.modelled and not marked:
            return _UNMARKED_RUB_MARGIN_NATS
        return rules.margin_nats

    close = [name for name in scores if scores[best] - scores[name] < margin(name)]
    doubt = max(margin("rub"), _MISFIT * scores[best])
    if marked and best == "unmodelled" and "rub" not in close and scores[best] - scores["rub"] < doubt:
        close.append("rub")
    if "normal" in close and best != "normal":
        close.remove("normal")
    return tuple(sorted(close, key=lambda name: -scores[name]))


def posterior(scores: Mapping[RotorFault, float]) -> dict[RotorFault, float]:
    """Probabilities of hypotheses that are equally likely before, by tempered likelihoods."""
    top = max(scores.values())
    weights = {name: math.exp((score - top) / TEMPERATURE) for name, score in scores.items()}
    total = math.fsum(weights.values())
    return {name: weight / total for name, weight in weights.items()}
