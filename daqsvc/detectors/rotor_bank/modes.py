"""The modes of a rotor bank in physical terms, and the models that they represent."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal, get_args

from daqsvc.rotor.discretise import BankMode
from daqsvc.rotor.model import SAME_PEDESTAL, Pedestal

if TYPE_CHECKING:
    from collections.abc import Sequence

    from daqsvc.diagnosis.record import Severity
    from daqsvc.rotor.model import NormalisedRotor, RotorParameters

_PROCESS_NOISE = 1e-4
"""That of the paper's rotor."""
_USUAL_ORBIT = 0.1
"""Orbit, in clearances, from which it holds for any rotor."""

UNMODELLED = "unmodelled"
"""What a change is called that no fault explains."""
Fault = Literal["unbalance", "damping_loss", "static_load", "stiffness_loss", "rub"]


@dataclass(frozen=True, slots=True)
class RotorMode:
    """A mode of the rotor: what differs from the healthy one, at one level.

    Attributes:
        name: name of the mode.
        damping_ratio: zeta in this mode; the healthy one if None.
        severity: how bad it is.
        rub: whether the shaft can touch its housing, so that the observer includes the contact.
        fault: what the mode is called; told from what differs if None (`fault_of`).
        unbalance_ratio: eccentricity over the healthy one.
        stiffness_ratio: k, stiffness over the healthy one.
        static_load_um: additional static load towards +x and +y, as the sag of the healthy shaft under it.
    """

    name: str
    damping_ratio: float | None = None
    severity: Severity = "normal"
    rub: bool = False
    fault: Fault | None = None
    unbalance_ratio: float = 1.0
    stiffness_ratio: float = 1.0
    static_load_um: tuple[float, float] = (0.0, 0.0)

    def __post_init__(self) -> None:
        if not (math.isfinite(self.unbalance_ratio) and self.unbalance_ratio >= 0.0):
            raise ValueError(
                f"mode {self.name!r}: unbalance_ratio is {self.unbalance_ratio}; it must be 0 or above"
            )


def fault_of(mode: RotorMode, rotor: RotorParameters) -> Fault | Literal["normal"]:
    """What a mode is in the words of a verdict.

    Where several things differ, the one that a person should know first: a rub before what led to it,
    and an external cause before damping, which often only follows.

    Args:
        mode: the mode.
        rotor: the healthy rotor.
    """
    less_damping = mode.damping_ratio is not None and mode.damping_ratio < rotor.damping_ratio
    differs: dict[Fault, bool] = {
        "rub": mode.rub,
        "static_load": any(mode.static_load_um),
        "stiffness_loss": mode.stiffness_ratio != 1.0,
        "unbalance": mode.unbalance_ratio != 1.0,
        "damping_loss": less_damping,
    }
    named = (fault for fault, does in differs.items() if does)
    return mode.fault or next(named, None) or "normal"


def is_one_fault(mode: RotorMode, rotor: RotorParameters) -> bool:
    """Whether a mode is one fault and nothing else; a rub may have any cause.

    Args:
        mode: a faulty mode.
        rotor: the healthy rotor.
    """
    if mode.rub:
        return True
    damped = rotor.damping_ratio if mode.damping_ratio is None else mode.damping_ratio
    differs: dict[Fault, bool] = {
        "unbalance": mode.unbalance_ratio != 1.0,
        "damping_loss": damped < rotor.damping_ratio,
        "static_load": any(mode.static_load_um),
        "stiffness_loss": mode.stiffness_ratio < 1.0,
    }
    grown = damped > rotor.damping_ratio or mode.stiffness_ratio > 1.0
    return not grown and [name for name, does in differs.items() if does] == [fault_of(mode, rotor)]


def named_besides(modes: Sequence[RotorMode], rotor: RotorParameters, *, ac_coupled: bool) -> tuple[str, ...]:
    """What a bank names besides its modes: faults that none of them is, and a change that no fault explains.

    Nothing, unless the rotor comes from a run-up, every mode is one fault, and the probes show the mean
    position: only then the signatures judge the steady motion.

    Args:
        modes: the modes, healthiest first.
        rotor: the healthy rotor.
        ac_coupled: whether the probes show no static position.
    """
    if ac_coupled or rotor.two_modes is None or not all(is_one_fault(mode, rotor) for mode in modes[1:]):
        return ()
    known = {fault_of(mode, rotor) for mode in modes}
    return (*(fault for fault in get_args(Fault) if fault not in known), UNMODELLED)


def usual_process_noise(healthy: NormalisedRotor) -> float:
    """Power spectral density q of observers for which none is given, normalised.

    What shakes a shaft goes with its whirl. On long rotors the orbit is a hundredth of the clearance, which
    the sag fills: an observer that allows for the shaking of a large orbit follows every change there.

    Args:
        healthy: the healthy rotor, with the orbit that it has.
    """
    if healthy.isotropic:
        return _PROCESS_NOISE
    return _PROCESS_NOISE * min(1.0, abs(healthy.orbit()) / _USUAL_ORBIT) ** 2


def bank_modes(
    modes: Sequence[RotorMode],
    rotor: RotorParameters,
    speed_rpm: float,
    *,
    process_noise: float | None = None,
    rub_process_noise: float = 0.1,
    ac_coupled: bool = False,
) -> tuple[BankMode, ...]:
    """The models of a bank.

    Args:
        modes: the modes, healthy first.
        rotor: the healthy rotor; exponent and friction are those of the rub observers.
        speed_rpm: speed of the shaft; negative if it turns clockwise.
        process_noise: power spectral density q of the linear observers, normalised; `usual_process_noise`
            if not given.
        rub_process_noise: that of the rub observers.
        ac_coupled: whether the probes show no static position, so that every orbit lies about 0.

    Raises:
        ValueError: a figure is outside what the model can mean, or a mode differs in nothing that AC-coupled
            probes show.
    """
    made = []
    for mode in modes:
        if ac_coupled and any(mode.static_load_um):
            raise ValueError(
                f"mode {mode.name!r} is a static load of {list(mode.static_load_um)} um, but the probes are "
                "AC-coupled and show no static position; use DC-coupled probes, or remove the mode"
            )
        # What gives way below an oil film has no damper beside it: both, and the shaft, are in series.
        in_series = rotor.on_film and rotor.two_modes is not None
        changed = rotor.faulty(
            speed_rpm,
            damping_ratio=mode.damping_ratio,
            unbalance_ratio=mode.unbalance_ratio,
            stiffness_ratio=1.0 if in_series else mode.stiffness_ratio,
            pedestal=Pedestal(1.0 / mode.stiffness_ratio - 1.0) if in_series else SAME_PEDESTAL,
            static_load_um=complex(*mode.static_load_um),
        )
        if ac_coupled:
            changed = replace(changed, load_x=0.0, g=0.0)
        if process_noise is None:
            process_noise = usual_process_noise(changed)
        made.append(BankMode(mode.name, changed, rub_process_noise if mode.rub else process_noise, mode.rub))
    return tuple(made)
