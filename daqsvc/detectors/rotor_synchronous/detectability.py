"""What the synchronous vector can see of a machine's rotor, before anything breaks."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, TypedDict

from daqsvc.detectors.rotor_synchronous.build import healthy_rotor
from daqsvc.rotor.detectability.vector import stated_calibration, vector_detectability
from daqsvc.rotor.synchronous.departure import threshold_for
from daqsvc.rotor.synchronous.vectors import HARMONICS

if TYPE_CHECKING:
    from daqsvc.detectors.rotor_synchronous.settings import RotorSynchronous
    from daqsvc.rotor.detectability.vector import VectorDetectability, VisibleFault
    from daqsvc.settings import MachineFile

_COMPONENTS = ("mean position", "forward 1X", "backward 1X", "forward 2X", "backward 2X")
_QUANTITIES = {
    "unbalance": ("unbalance, times the healthy one", ""),
    "damping_loss": ("damping ratio", ""),
    "stiffness_loss": ("stiffness, of the healthy one", ""),
    "static_load": ("static load, as further sag", " um"),
}


def synchronous_detectability(
    machine: MachineFile,
    settings: RotorSynchronous,
    *,
    noise_um: float | None,
    eccentricity_um: float | None,
) -> VectorDetectability:
    """Detectability of the calibrated rotor that the service would run for a machine file.

    Args:
        machine: the machine file.
        settings: the table of its calibrated rotor.
        noise_um: standard deviation of one probe's noise, where no calibration has it.
        eccentricity_um: mass eccentricity, where neither calibration nor machine file has it.

    Raises:
        ValueError: something is not known, or cannot be used; the message names the option for it.
    """
    rotor_table = machine.machine.rotor
    assert rotor_table is not None  # noqa: S101 - detectors/shaft/checks.py: it needs [machine.rotor]
    threshold_nats = threshold_for(settings.false_alarms_per_1000_rev)
    rotor, calibrations = healthy_rotor(machine, settings)
    if calibrations:
        calibration = calibrations[0]
    else:
        eccentricity_um = eccentricity_um or rotor_table.eccentricity_um
        lacking = [
            option
            for option, value in (("--noise-um", noise_um), ("--eccentricity-um", eccentricity_um))
            if value is None
        ]
        if noise_um is None or eccentricity_um is None:
            raise ValueError(
                f"no calibration tells how the healthy machine whirls and how noisy its probes are: give "
                f"{' and '.join(lacking)}, or calibrate the machine and name the file as "
                "pipeline.rotor_synchronous.calibration"
            )
        rate_hz = machine.grid(settings.sampled_together).rate_hz
        calibration = stated_calibration(
            rotor,
            speed_rpm=machine.machine.speed_rpm,
            samples_per_rev=60.0 * rate_hz / abs(machine.machine.speed_rpm),
            noise_um=noise_um,
            eccentricity_um=eccentricity_um,
            revolutions=settings.calibrate_revolutions,
        )
    return vector_detectability(
        calibration, threshold_nats, probe_drift_um=settings.probe_drift_um, ac_coupled=machine.ac_coupled
    )


class DelayJson(TypedDict):
    """How soon a larger change is an alarm.

    Attributes:
        size: the quantity after the change.
        delay_rev: revolutions until half of all are an alarm; null if they never are.
    """

    size: float
    delay_rev: float | None


class VisibleFaultJson(TypedDict):
    """How small a fault of one kind is seen.

    Attributes:
        fault: the kind.
        quantity: what changes.
        unit: unit of that; empty if it has none.
        healthy: the quantity of the healthy machine.
        by_vector: the quantity at which the change is seen at last; null if it never is.
        change_um: change of the synchronous vector there; null with it.
        delays: how soon larger ones are an alarm.
    """

    fault: str
    quantity: str
    unit: str
    healthy: float
    by_vector: float | None
    change_um: float | None
    delays: list[DelayJson]


class OneGroupJson(TypedDict):
    """Faults that look the same at this speed.

    Attributes:
        modes: names of the faults.
        misfit_nats: evidence that tells them apart.
        opens_at_rpm: nearest speed that tells them apart; null if there is none.
        told_by_transient: whether the transient after an abrupt change tells them apart.
    """

    modes: list[str]
    misfit_nats: float | None
    opens_at_rpm: float | None
    told_by_transient: bool


class VectorDetectabilityJson(TypedDict):
    """What the calibrated rotor can see.

    Attributes:
        machine: name of the machine.
        speed_rpm: speed that the figures are for, negative if clockwise.
        samples_per_rev: samples in a revolution.
        noise_um: noise of a sample, standard deviation.
        amplitude_um: amplitude of 1X of the healthy machine.
        calibration_rev: revolutions of the calibration.
        false_alarms_per_1000_rev: the rate of false alarms that the threshold is set for.
        threshold_nats: evidence for an alarm.
        smallest_um: by order the smallest change of the vector that can be seen; null if it never is.
        smallest_change: the smallest visible change of each kind.
        ambiguous: faults that look the same at this speed.
    """

    machine: str
    speed_rpm: float
    samples_per_rev: float
    noise_um: float
    amplitude_um: float
    calibration_rev: float
    false_alarms_per_1000_rev: float
    threshold_nats: float
    smallest_um: dict[str, float | None]
    smallest_change: list[VisibleFaultJson]
    ambiguous: list[OneGroupJson]


def as_json(
    prediction: VectorDetectability, machine: MachineFile, settings: RotorSynchronous
) -> VectorDetectabilityJson:
    """The figures; what is never reached is null.

    Args:
        prediction: the figures.
        machine: the machine file that they are for.
        settings: the table of its calibrated rotor.
    """
    was = prediction.calibration
    return {
        "machine": machine.machine.name,
        "speed_rpm": math.copysign(was.speed_rpm, machine.machine.speed_rpm),
        "samples_per_rev": was.samples_per_rev,
        "noise_um": was.noise_um,
        "amplitude_um": was.amplitude_um,
        "calibration_rev": was.revolutions,
        "false_alarms_per_1000_rev": settings.false_alarms_per_1000_rev,
        "threshold_nats": prediction.threshold_nats,
        "smallest_um": {
            str(order): value if math.isfinite(value) else None
            for order, value in zip(HARMONICS, prediction.smallest_um.tolist(), strict=True)
        },
        "smallest_change": [
            {
                "fault": one.fault,
                "quantity": _QUANTITIES[one.fault][0],
                "unit": _QUANTITIES[one.fault][1].strip(),
                "healthy": one.healthy,
                "by_vector": one.smallest,
                "change_um": one.change_um,
                "delays": [{"size": delay.size, "delay_rev": delay.revolutions} for delay in one.delays],
            }
            for one in prediction.faults
        ],
        "ambiguous": [
            {
                "modes": ["unbalance", "damping_loss"],
                "misfit_nats": prediction.misfit_nats,
                "opens_at_rpm": prediction.opens_at_rpm,
                "told_by_transient": prediction.told_by_transient,
            }
        ]
        if prediction.one_group
        else [],
    }


def as_text(prediction: VectorDetectability, machine: MachineFile) -> str:
    """Tables and sentences for a person.

    Args:
        prediction: the figures.
        machine: the machine file that they are for.
    """
    was = prediction.calibration
    head = (
        f"{machine.machine.name} at {was.speed_rpm:.6g} rpm, by its synchronous vector: 1X "
        f"{was.amplitude_um:.4g} um, {was.samples_per_rev:.4g} samples a revolution,\n"
        f"noise {was.noise_um:.3g} um, {was.revolutions} revolutions of calibration; a change is an alarm at "
        f"{prediction.threshold_nats:.3g} nats"
    )
    components = [
        "Smallest change of a component that can be seen",
        *(
            f"{name:>34}{f'{value:.3g} um' if math.isfinite(value) else 'never':>12}"
            for name, value in zip(_COMPONENTS, prediction.smallest_um.tolist(), strict=True)
        ),
    ]
    faults = [
        "Smallest change of every kind, and revolutions until larger ones are an alarm",
        f"{'':>34}{'healthy':>12}{'smallest':>12}   larger ones",
        *(_row(one) for one in prediction.faults),
    ]
    return "\n\n".join([head, "\n".join(components), "\n".join(faults), _ambiguity(prediction)])


def _row(one: VisibleFault) -> str:
    quantity, unit = _QUANTITIES[one.fault]
    smallest = "never" if one.smallest is None else f"{one.smallest:.4g}{unit}"
    larger = ", ".join(
        f"{delay.size:.3g}{unit} " + ("never" if delay.revolutions is None else f"in {delay.revolutions:.0f}")
        for delay in one.delays
    )
    return f"{quantity:>34}{f'{one.healthy:.3g}{unit}':>12}{smallest:>12}   {larger}".rstrip()


def _ambiguity(prediction: VectorDetectability) -> str:
    was = prediction.calibration
    if not prediction.one_group:
        sentence = (
            f"At {was.speed_rpm:.6g} rpm no loss of damping moves 1X as unbalance does: a grown unbalance is "
            "told from it. What a loss of damping does, another unbalance can do as well"
        )
    else:
        sentence = f"Unbalance and loss of damping are one group at {was.speed_rpm:.6g} rpm"
        sentence += (
            ", and at any speed within 30 % of it"
            if prediction.opens_at_rpm is None
            else f"; at {prediction.opens_at_rpm:.6g} rpm a grown unbalance is told from it"
        )
    transient = (
        "The transient of an abrupt change tells them apart, too."
        if prediction.told_by_transient
        else "A rotor known within 5 % would tell them apart by the transient of an abrupt change: calibrate "
        "with a run-up."
    )
    return f"{sentence}.\n{transient}"
