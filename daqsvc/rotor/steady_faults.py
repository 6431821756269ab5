"""Which faults of a live bank explain a steady change, by the signatures of the calibrated rotor.

The steady motion of one mode each shows how far a change is from a few exact predictions. But real supports
are none of them: an oil film gives way aside, a load comes from where it comes. The signatures
(`daqsvc.rotor.synchronous.signatures`) average over what is not known of a fault, and over how far the two
modes of a run-up may be off. A bank that has measured its healthy machine can ask them the same question.

A rub is asked for otherwise. The bank knows the clearance, so its orbit has to reach the wall. There it
leaves harmonics, or goes around.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from daqsvc.rotor.adaptation import MODEL_ERROR
from daqsvc.rotor.laval import LavalRotor
from daqsvc.rotor.misfit import LEAST_REVOLUTIONS, Misfit
from daqsvc.rotor.synchronous.contact import contact_would_show, has_marks, reaches_wall, whirls_around
from daqsvc.rotor.synchronous.pulses import rub_pulse
from daqsvc.rotor.synchronous.signatures import (
    NAMED_BY_RUN_UP,
    UNMODELLED_NATS,
    anything,
    linear_faults,
    posterior,
    unmodelled,
)
from daqsvc.rotor.synchronous.vectors import DC, HARMONICS, Healthy

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from collections.abc import Set as AbstractSet

    from numpy.typing import NDArray

    from daqsvc.rotor.misfit import SteadyChange
    from daqsvc.rotor.model import RotorParameters
    from daqsvc.rotor.synchronous.signatures import RotorFault

    Complexes = NDArray[np.complex128]
    Floats = NDArray[np.float64]

_ORDER = [2, 0, 1, 3, 4, 5, 6]
"""Where the components of `daqsvc.rotor.synchronous.vectors.WITH_THRICE` are in a steady motion."""
_ONLY_1X = frozenset({"unbalance", "damping_loss"})
_OFF, _OFF_DC = 0.002, 0.01
"""Parts of the healthy orbit by which components may be off, and the mean position, as probes drift."""
_MOST_REVOLUTIONS = 128
"""Revolutions after which a change that goes on is judged again."""


@dataclass(frozen=True, slots=True)
class Explanation:
    """What explains a steady change, none of it much better than the rest.

    Attributes:
        faults: those that the bank has a mode of; none if it has no mode for the change.
        others: those that it has none of, and ``"unmodelled"``; the likeliest first.
        probabilities: of the others.
        evidence: of the others over no change, nats.
        samples: that the change was judged by.
    """

    faults: frozenset[str]
    others: tuple[str, ...] = ()
    probabilities: Mapping[str, float] = field(default_factory=dict)
    evidence: Mapping[str, float] = field(default_factory=dict)
    samples: int = 0

    @property
    def is_no_mode(self) -> bool:
        """Whether no mode explains the change: which of them is nearest means nothing then."""
        return not self.faults


class SteadyFaults:
    """Judges steady changes of one machine.

    Args:
        rotor: the healthy rotor, with the two modes of its run-up.
        faults: ``[M]``, what each mode of the bank is called: ``"normal"``, ``"rub"``, ...
        motions: complex128 ``[M, 7]``, of `SteadyMotions`; the first is healthy. Its loads show from where
            one is expected.
        baseline: complex128 ``[7]``, the measured healthy motion, in clearances, in their order.
        variance: float64 ``[7]``, of it, squared clearances.
        speed_rad_s: shaft speed at which it was measured; negative if the shaft turns clockwise.
    """

    def __init__(
        self,
        rotor: RotorParameters,
        faults: Sequence[str],
        motions: Complexes,
        *,
        baseline: Complexes,
        variance: Floats,
        speed_rad_s: float,
    ) -> None:
        self._scale_um = rotor.clearance_um
        self._faults = np.array(faults)
        self._names = set(faults) - {"normal"}
        self._variance = variance[_ORDER]
        known = LavalRotor(
            natural_frequency_hz=rotor.natural_frequency_hz,
            damping_ratio=rotor.damping_ratio,
            clearance_um=rotor.clearance_um,
            static_sag_um=rotor.static_sag_um,
            two_modes=replace(rotor, clearance_um=1.0),
            plain_bearings=rotor.plain_bearings,
        )
        vector = self._scale_um * baseline[_ORDER]
        self._healthy = Healthy(vector[: len(HARMONICS)], speed_rad_s, known, laval=False)
        shifts = (motions - motions[0])[self._faults == "static_load", 2]
        shifts = shifts[np.isfinite(shifts) & (shifts != 0.0)]  # a shaft that may touch and does not has none
        self._load_towards: Complexes = shifts / np.abs(shifts)
        self.least_load = float(np.min(np.abs(shifts), initial=math.inf))
        """How far the mildest load mode moves the shaft, in clearances; infinite without one."""
        self._likely: Explanation | None = None
        self._held: Explanation | None = None
        self._judged_samples, self._since = 0, 0

    @property
    def found(self) -> Explanation | None:
        """What explained the change when it was judged last; None before that.

        An evaluation that shows nothing, as of a change that has become small, does not remove it.
        """
        return self._held

    def look(self, change: SteadyChange) -> None:
        """Judge a change that goes on: first at once, then as often as its length has doubled.

        It is called once a revolution, and the signatures take longer than one at high speeds.
        """
        self._since += 1
        renewed = change.samples >= 2 * self._judged_samples or change.samples < self._judged_samples
        if (renewed and self._since >= LEAST_REVOLUTIONS) or self._since >= _MOST_REVOLUTIONS:
            self._likely = self.likely(change)
            self._held = self._likely or self._held
            self._judged_samples, self._since = change.samples, 0

    def forget(self) -> None:
        """The change is over."""
        self._likely = self._held = None
        self._judged_samples, self._since = 0, LEAST_REVOLUTIONS

    def likely(self, change: SteadyChange) -> Explanation | None:
        """What explains a change.

        None where it has no harmonics to judge by, where it is small, and before it is there.
        """
        if len(change.moved) < len(_ORDER) or not np.isfinite(change.moved).all():
            return None
        scale, healthy = self._scale_um, self._healthy
        moved = scale * change.moved[_ORDER]
        if np.linalg.norm(moved) < NAMED_BY_RUN_UP.least_severity * healthy.amplitude_um:
            return None
        of_mean = np.zeros(len(_ORDER)) if change.variance is None else change.variance[_ORDER]
        off = np.full(len(_ORDER), _OFF * healthy.amplitude_um)
        off[DC] = _OFF_DC * healthy.amplitude_um
        variance = scale**2 * (self._variance + of_mean) + off**2
        scores = linear_faults(moved, variance, healthy, load_towards=self._load_towards)
        scores["rub"] = _rub(moved, variance, healthy)
        scores["unmodelled"] = unmodelled(moved, variance, healthy)
        least = max(scores.values()) - NAMED_BY_RUN_UP.margin_nats
        if scores["normal"] > least:
            return None
        near: list[RotorFault] = [name for name in scores if scores[name] > least]
        near.sort(key=lambda name: -scores[name])
        faults, others = self._names.intersection(near), [name for name in near if name not in self._names]
        if _ONLY_1X.intersection(others):
            # The steady motion alone does not tell these two apart for certain.
            faults |= self._names & _ONLY_1X
        probabilities = posterior(scores)
        return Explanation(
            frozenset(faults),
            tuple(others),
            {name: probabilities[name] for name in others},
            {name: scores[name] - scores["normal"] for name in others},
            change.samples,
        )

    def predicted(self, change: SteadyChange) -> frozenset[str] | None:
        """The same of a change that the model predicts: all that it may be called if the model is off.

        Args:
            change: from healthy to where a mode takes the machine.
        """
        found = self.likely(change)
        if found is None:
            return None
        names = {*found.faults, *found.others}
        for quarter in range(4):
            off = np.ones(len(_ORDER), dtype=np.complex128)
            turned = MODEL_ERROR * 1j**quarter
            off[:3] += turned, turned.conjugate(), MODEL_ERROR * (-1) ** quarter
            if found := self.likely(replace(change, moved=off * change.moved)):
                names.update(found.faults, found.others)
        return frozenset(names)

    def narrowed(self, off: Misfit) -> Misfit:
        """What a change excludes and leaves together by the signatures, where they have judged it.

        Unbalance and loss of damping are told apart only where the modes' own motions agree.

        Args:
            off: the same by the modes' own motions.
        """
        return off if self._likely is None else narrowed(off, self._faults, self._likely.faults)


def narrowed(off: Misfit, faults: NDArray[np.str_], likely: AbstractSet[str]) -> Misfit:
    """What is excluded and left together of the modes, if only these faults are likely.

    Args:
        off: by the modes' own motions.
        faults: ``[M]``, what each mode is called.
        likely: of the faults. If there is none, all of them stay together: the change is no mode's.
    """
    names = set(likely & set(faults.tolist())) or set(faults.tolist()) - {"normal"}
    pair = names & _ONLY_1X
    if len(pair) == 1 and pair != set(faults[~off.excluded].tolist()) & _ONLY_1X:
        names |= _ONLY_1X & set(faults.tolist())
    close = np.isin(faults, list(names))
    # The healthy mode is excluded, too: what is judged is a change. Else it would win where the motion is
    # that of no mode, and the change would be found and lost again and again.
    pairs = np.logical_and.outer(close, close) & (faults[:, np.newaxis] != faults)
    return replace(off, excluded=~close, pairs=pairs)


def _rub(change: Complexes, variance: Floats, healthy: Healthy) -> float:
    """Log marginal likelihood of a rub.

    A rub of a bank is an unbalance that has grown until the shaft touches. So 1X moves by more than the
    wall's push, and where contact is certain, any change may be one.
    """
    position = healthy.baseline + change[: len(HARMONICS)]
    if not reaches_wall(position, healthy):
        return -math.inf
    pulse = rub_pulse(change, variance, healthy, position)
    free = anything(change, variance, healthy)
    vector, of_vector = change[: len(HARMONICS)], variance[: len(HARMONICS)]
    if has_marks(vector, of_vector) or whirls_around(position, healthy):
        return max(pulse, free + UNMODELLED_NATS)
    return -math.inf if contact_would_show(vector, of_vector) else max(pulse, free)
