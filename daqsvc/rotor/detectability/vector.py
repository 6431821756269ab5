"""What the synchronous vector of a calibrated rotor can see and tell apart, before any fault happens.

The departure test compares the mean of the last m revolutions with the n healthy ones before them:
``T = sum over k of |d_k|^2 / (v_k (1/m + 1/n) + floor)``. A change is visible if T reaches the threshold h
with the longest window; for white noise and a long window that is ``delta_min = sqrt(h / (n N SNR))``. A loss
of damping and an unbalance move 1X alone: they are one group wherever the one can bring 1X to where the other
does (`damping_misfit`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal

import numpy as np

from daqsvc.rotor.laval import compliance, unbalance_response
from daqsvc.rotor.synchronous.baseline import Calibration
from daqsvc.rotor.synchronous.departure import WINDOWS
from daqsvc.rotor.synchronous.signatures import damping_misfit, naming_of
from daqsvc.rotor.synchronous.transient import KNOWN_WITHIN
from daqsvc.rotor.synchronous.vectors import DC, FORWARD

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray

    from daqsvc.rotor.laval import LavalRotor

    Complexes = NDArray[np.complex128]
    Floats = NDArray[np.float64]

VectorFault = Literal["unbalance", "damping_loss", "stiffness_loss", "static_load"]

_HARMONIC_FIT = 5
"""Complex figures that the fit of a revolution takes from its samples."""
_SEVERITIES = np.geomspace(1e-4, 0.98, 400)
_SETTLED = 50.0
"""Revolutions in the mean of a change when it is asked what it may be."""
_SPEEDS = np.linspace(0.7, 1.3, 61)
"""Speeds over the present one at which a group may open."""
_GROWN = 2.0
"""The unbalance that a loss of damping is asked to make: a doubled one, at the angle of the healthy one."""


@dataclass(frozen=True, slots=True)
class DetectionDelay:
    """How soon a change is seen.

    Attributes:
        size: the quantity with the change, in the terms of its kind.
        revolutions: in the window that sees it; None if none does.
    """

    size: float
    revolutions: float | None


@dataclass(frozen=True, slots=True)
class VisibleFault:
    """How small a fault of one kind is seen, and how soon larger ones are.

    Attributes:
        fault: ``unbalance`` (1X over the healthy one), ``damping_loss`` (damping ratio left),
            ``stiffness_loss`` (stiffness left) or ``static_load`` (further sag in um).
        healthy: the quantity of the healthy machine.
        smallest: the quantity at which a change is seen at last; None if it never is.
        change_um: modulus of the synchronous vector's change there; None with it.
        delays: of some sizes.
    """

    fault: VectorFault
    healthy: float
    smallest: float | None
    change_um: float | None
    delays: tuple[DetectionDelay, ...]


@dataclass(frozen=True, slots=True)
class VectorDetectability:
    """What the synchronous vector can see of one machine.

    Attributes:
        calibration: the healthy machine, measured or stated.
        threshold_nats: of the departure test.
        smallest_um: float64 ``[5]``, smallest visible change of each component, in the order of `HARMONICS`.
        faults: by kind.
        misfit_nats: how far a doubled unbalance lies from all that a loss of damping can do.
        margin_nats: from which on the two are told apart.
        opens_at_rpm: nearest speed at which it is; None if it is at this speed, or nowhere near.
    """

    calibration: Calibration
    threshold_nats: float
    smallest_um: Floats
    faults: tuple[VisibleFault, ...]
    misfit_nats: float
    margin_nats: float
    opens_at_rpm: float | None

    @property
    def one_group(self) -> bool:
        """Whether unbalance and loss of damping are one group at this speed."""
        return self.misfit_nats < self.margin_nats

    @property
    def told_by_transient(self) -> bool:
        """Whether the rotor is known well enough for the transient of an abrupt change to tell them apart."""
        rotor = self.calibration.rotor
        known = max(rotor.natural_frequency_tolerance, rotor.damping_tolerance) <= KNOWN_WITHIN
        return known and self.calibration.laval


def stated_calibration(
    rotor: LavalRotor,
    *,
    speed_rpm: float,
    samples_per_rev: float,
    noise_um: float,
    eccentricity_um: float,
    revolutions: int,
) -> Calibration:
    """The healthy machine as stated, in white noise, where nothing has been measured yet.

    Args:
        rotor: what is known about it.
        speed_rpm: shaft speed of either sign.
        samples_per_rev: samples in a revolution.
        noise_um: standard deviation of the noise of one probe.
        eccentricity_um: mass eccentricity.
        revolutions: of calibration.

    Raises:
        ValueError: too few samples a revolution.
    """
    if samples_per_rev <= _HARMONIC_FIT:
        raise ValueError(
            f"{samples_per_rev:.3g} samples a revolution do not tell 1X and 2X; sample at more than "
            f"{_HARMONIC_FIT * abs(speed_rpm) / 60.0:.4g} Hz"
        )
    ratio = abs(speed_rpm) / 60.0 / rotor.natural_frequency_hz
    baseline = np.zeros(5, dtype=np.complex128)
    baseline[DC] = -1j * rotor.sag_um
    baseline[FORWARD] = eccentricity_um * unbalance_response(ratio, rotor.damping_ratio)
    noise = 2.0 * noise_um**2
    return Calibration(
        rotor=rotor,
        speed_rpm=abs(speed_rpm),
        revolutions=revolutions,
        baseline=baseline,
        variance=np.full(5, noise / samples_per_rev),
        noise=noise,
        noise_variance=1.0 / (samples_per_rev - _HARMONIC_FIT),
        samples_per_rev=samples_per_rev,
    )


def vector_detectability(
    calibration: Calibration,
    threshold_nats: float,
    *,
    probe_drift_um: float = 0.0,
    ac_coupled: bool = False,
) -> VectorDetectability:
    """What can be seen and told apart from a healthy state on.

    Args:
        calibration: the healthy state.
        threshold_nats: of the departure test.
        probe_drift_um: standard deviation of the mean position that is drift of the probes.
        ac_coupled: whether the probes show no mean position.
    """
    drift = math.inf if ac_coupled else probe_drift_um**2
    spread = replace(calibration.spread, drift=drift)
    reference = float(calibration.revolutions)
    last = spread.of_means(float(WINDOWS[-1]), reference)
    margin = naming_of(calibration.rotor).margin_nats
    misfit = _misfit(calibration, calibration.speed_rpm)
    nearest = sorted(_SPEEDS, key=lambda part: abs(part - 1.0))
    opens = (part for part in nearest if _misfit(calibration, part * calibration.speed_rpm) >= margin)
    opens_at = None if misfit >= margin else next(opens, None)

    def evidence(change: Complexes, variance: Floats) -> float:
        return float(np.sum(np.abs(change) ** 2 / variance))

    def visible(kind: _VectorFaultKind) -> VisibleFault:
        if ac_coupled and kind.fault == "static_load":
            return VisibleFault(kind.fault, 0.0, None, None, ())
        severity = _first(lambda x: evidence(kind.change(calibration, x), last) / threshold_nats)
        delays = []
        for one in kind.shown:
            change = kind.change(calibration, one)
            windows = (
                float(m)
                for m in WINDOWS
                if evidence(change, spread.of_means(float(m), reference)) >= threshold_nats
            )
            delays.append(DetectionDelay(kind.quantity(calibration, one), next(windows, None)))
        return VisibleFault(
            kind.fault,
            kind.quantity(calibration, 0.0),
            None if severity is None else kind.quantity(calibration, severity),
            None if severity is None else float(np.linalg.norm(kind.change(calibration, severity))),
            tuple(delays),
        )

    return VectorDetectability(
        calibration=calibration,
        threshold_nats=threshold_nats,
        smallest_um=np.sqrt(threshold_nats * last),
        faults=tuple(visible(kind) for kind in _KINDS),
        misfit_nats=misfit,
        margin_nats=margin,
        opens_at_rpm=None if opens_at is None else float(opens_at) * calibration.speed_rpm,
    )


@dataclass(frozen=True, slots=True)
class _VectorFaultKind:
    """A kind of fault by severity from 0: its quantity, what it does to the vector, and what is shown."""

    fault: VectorFault
    quantity: Callable[[Calibration, float], float]
    change: Callable[[Calibration, float], Complexes]
    shown: Sequence[float]


def _unbalance(healthy: Calibration, severity: float) -> Complexes:
    return _only(FORWARD, severity * healthy.baseline[FORWARD])


def _damping(healthy: Calibration, severity: float) -> Complexes:
    rotor = healthy.rotor
    ratio = healthy.speed_rad_s / rotor.natural_frequency_rad_s
    before = unbalance_response(ratio, rotor.damping_ratio)
    after = unbalance_response(ratio, rotor.damping_ratio * (1.0 - severity))
    return _only(FORWARD, healthy.baseline[FORWARD] * complex(after / before - 1.0))


def _stiffness(healthy: Calibration, severity: float) -> Complexes:
    rotor, left = healthy.rotor, 1.0 - severity
    ratio = healthy.speed_rad_s / rotor.natural_frequency_rad_s
    before = compliance(ratio, rotor.damping_ratio)
    # A softer spring: 1 / (k - w^2 + 2 i zeta w), the damper as it was.
    after = 1.0 / (1.0 / before - severity)
    change = _only(FORWARD, healthy.baseline[FORWARD] * complex(after / before - 1.0))
    change[DC] = -1j * rotor.sag_um * (1.0 / left - 1.0)
    return change


def _load(healthy: Calibration, severity: float) -> Complexes:
    return _only(DC, -1j * severity * _load_um(healthy))


def _load_um(healthy: Calibration) -> float:
    """The measure of a static load: the sag, or the whirl of a shaft that has none."""
    return healthy.rotor.sag_um or healthy.amplitude_um


def _only(component: int, value: complex) -> Complexes:
    change = np.zeros(5, dtype=np.complex128)
    change[component] = value
    return change


_KINDS = (
    _VectorFaultKind("unbalance", lambda _, x: 1.0 + x, _unbalance, (0.05, 0.2, 0.5)),
    _VectorFaultKind(
        "damping_loss", lambda c, x: c.rotor.damping_ratio * (1.0 - x), _damping, (0.1, 0.25, 0.5)
    ),
    _VectorFaultKind("stiffness_loss", lambda _, x: 1.0 - x, _stiffness, (0.02, 0.1, 0.3)),
    _VectorFaultKind("static_load", lambda c, x: x * _load_um(c), _load, (0.05, 0.2, 0.5)),
)


def _first(criterion: Callable[[float], float]) -> float | None:
    """The mildest severity at which a criterion passes 1; None if not even the worst one does."""
    values = np.array([criterion(float(severity)) for severity in _SEVERITIES])
    passed = np.flatnonzero(values >= 1.0)
    if not len(passed):
        return None
    i = int(passed[0])
    if i == 0:
        return float(_SEVERITIES[0])
    low, high = np.log(np.maximum(values[i - 1 : i + 1], 1e-300))
    part = -low / (high - low)
    return float(np.exp(np.interp(part, (0.0, 1.0), np.log(_SEVERITIES[i - 1 : i + 1]))))


def _misfit(calibration: Calibration, speed_rpm: float) -> float:
    """`damping_misfit` of a doubled unbalance, the rotor turning at another speed."""
    rotor = calibration.rotor
    ratio = speed_rpm / 60.0 / rotor.natural_frequency_hz
    baseline = calibration.baseline.copy()
    baseline[FORWARD] = calibration.eccentricity_um * unbalance_response(ratio, rotor.damping_ratio)
    there = replace(calibration, speed_rpm=speed_rpm, baseline=baseline)
    variance = there.spread.of_means(_SETTLED, float(calibration.revolutions))
    change = _only(FORWARD, (_GROWN - 1.0) * baseline[FORWARD])
    return damping_misfit(change, variance, there.healthy)
