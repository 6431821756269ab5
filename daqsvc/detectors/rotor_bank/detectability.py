"""What the rotor bank of a machine can tell apart, before anything breaks, in the machine file's units."""

from __future__ import annotations

import math
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

from daqsvc.rotor.adaptation import VARIANCE_FACTOR
from daqsvc.rotor.detectability.prediction import detectability

if TYPE_CHECKING:
    from collections.abc import Callable

    from daqsvc.detectors.rotor_bank.detector import RotorBankDetector
    from daqsvc.detectors.rotor_bank.settings import RotorBank
    from daqsvc.rotor.detectability.prediction import (
        Ambiguity,
        BankDetectability,
        PairEvidence,
        SmallestChange,
    )
    from daqsvc.settings import MachineFile

_QUANTITIES = {
    "unbalance": ("unbalance, times the healthy one", ""),
    "damping_loss": ("damping ratio", ""),
    "stiffness_loss": ("stiffness, of the healthy one", "%"),
    "static_load": ("static load, as further sag", "um"),
}


def bank_detectability(
    machine: MachineFile, given: RotorBank, detector: RotorBankDetector, process_noise: float | None
) -> BankDetectability:
    """Detectability of the bank that the service would run for a machine file.

    Args:
        machine: the machine file.
        given: its rotor bank.
        detector: made of that.
        process_noise: how much the machine itself shakes at random; None: what the bank says.

    Raises:
        ValueError: it cannot be computed of these figures.
    """
    return detectability(
        detector.bank_modes,
        noise=detector.noise,
        duration=detector.duration,
        threshold_nats=detector.rules.thresholds(len(detector.bank_modes)),
        variance_factor=VARIANCE_FACTOR if given.calibrate_revolutions > 0 else 1.0,
        process_noise=process_noise,
        ac_coupled=machine.ac_coupled,
    )


def as_json(found: BankDetectability, machine: MachineFile) -> dict[str, Any]:
    """The figures in the units of the machine file; what is never reached is null.

    Args:
        found: the figures.
        machine: the machine file that they are for.
    """
    units = _Units(machine)
    return {
        "machine": machine.machine.name,
        "speed_rpm": units.rpm(found.w),
        "samples_per_rev": found.samples_per_rev,
        "noise_um": units.um(found.noise),
        "process_noise": found.process_noise,
        "false_alarms_per_1000_rev": found.false_alarms_per_1000_rev,
        "modes": list(found.modes),
        "pairs": [asdict(pair) | {"delay_rev": _finite(pair.delay_rev)} for pair in found.pairs],
        "ambiguous": [
            {
                "modes": list(ambiguity.modes),
                "nats_per_rev": ambiguity.nats_per_rev,
                "opens_at_rpm": None if ambiguity.opens_at_w is None else units.rpm(ambiguity.opens_at_w),
                "open_nats_per_rev": ambiguity.open_nats_per_rev,
            }
            for ambiguity in found.ambiguities
        ],
        "smallest_change": [
            {
                "fault": change.fault,
                "quantity": _QUANTITIES[change.fault][0],
                "unit": _QUANTITIES[change.fault][1],
                "healthy": units.quantity(change, change.healthy),
                "by_bank": units.quantity(change, change.by_bank),
                "by_vector": units.quantity(change, change.by_vector),
            }
            for change in found.smallest
        ],
        "within_rev": found.within_rev,
        "calibration_rev": found.calibration_rev,
        "touching": list(found.touching),
    }


def as_text(found: BankDetectability, machine: MachineFile) -> str:
    """Tables and sentences for a person.

    Args:
        found: the figures.
        machine: the machine file that they are for.
    """
    units = _Units(machine)
    thresholds = sorted({pair.threshold_nats for pair in found.pairs})
    head = (
        f"{machine.machine.name} at {units.rpm(found.w):.6g} rpm: {len(found.modes)} modes, "
        f"{found.samples_per_rev:.4g} samples a revolution,\n"
        f"noise {units.um(found.noise):.3g} um, the machine's own process noise {found.process_noise:.3g}; "
        f"a mode is declared at {' or '.join(f'{nats:.3g}' for nats in thresholds)} nats"
    )
    paragraphs = [
        head,
        "Evidence in nats a revolution: the machine is in the mode of the row, against that of the column\n"
        + _matrix(found, lambda pair: pair.nats_per_rev),
        "Revolutions to declare the mode of the row after an abrupt change from that of the column (median)\n"
        + _matrix(found, lambda pair: pair.delay_rev),
    ]
    if any(pair.simulated for pair in found.pairs):
        paragraphs[-1] += "\n* from simulated runs of the rub; everything else is computed"
    paragraphs += [_smallest(found, units), "\n".join(_sentences(found, units))]
    return "\n\n".join(paragraphs)


class _Units:
    """From normalised quantities back to those of a machine file."""

    def __init__(self, machine: MachineFile) -> None:
        rotor = machine.machine.rotor
        assert rotor is not None  # noqa: S101 - settings/checks.py: a rotor bank needs [machine.rotor]
        self._natural_frequency_hz = rotor.natural_frequency_hz
        self._clearance_um = rotor.clearance_um

    def rpm(self, w: float) -> float:
        return 60.0 * w * self._natural_frequency_hz

    def um(self, clearances: float) -> float:
        return clearances * self._clearance_um

    def quantity(self, change: SmallestChange, value: float | None) -> float | None:
        if value is None:
            return None
        if change.fault == "stiffness_loss":
            return 100.0 * value
        return self.um(value) if change.fault == "static_load" else value


def _matrix(found: BankDetectability, figure: Callable[[PairEvidence], float]) -> str:
    width = max(6, *(len(name) for name in found.modes)) + 1
    rows = ["".join(name.rjust(width) for name in ("", *found.modes))]
    for truth in found.modes:
        row = truth.rjust(width)
        for rival in found.modes:
            if truth == rival:
                row += ".".rjust(width)
            else:
                pair = found.pair(truth, rival)
                mark = "*" if pair.simulated else " "
                row += (_figure(figure(pair)) + mark).rjust(width)
        rows.append(row.rstrip())
    return "\n".join(rows)


def _smallest(found: BankDetectability, units: _Units) -> str:
    head = (
        "Smallest change that can be seen: by a mode of the bank made for it, half of the time within "
        f"{found.within_rev:.4g}\nrevolutions; and by the synchronous vector, however long it takes, "
        f"from {found.calibration_rev:.4g} revolutions of calibration"
    )
    rows = [
        head,
        f"{'':>34}{'healthy':>12}{'bank':>12}{'vector':>12}",
    ]
    for change in found.smallest:
        quantity, unit = _QUANTITIES[change.fault]
        values = (units.quantity(change, v) for v in (change.healthy, change.by_bank, change.by_vector))
        cells = ("never" if v is None else f"{v:.3g} {unit}".rstrip() for v in values)
        rows.append(f"{quantity:>34}" + "".join(f"{cell:>12}" for cell in cells))
    return "\n".join(rows)


def _sentences(found: BankDetectability, units: _Units) -> list[str]:
    rpm = f"{units.rpm(found.w):.6g} rpm"
    said = [_ambiguity(found, ambiguity, rpm, units) for ambiguity in found.ambiguities]
    if not said:
        closest = min(found.pairs, key=lambda pair: pair.nats_per_rev)
        said.append(
            f"All modes can be told apart at {rpm}; {closest.truth} and {closest.rival} are the closest, "
            f"{_figure(closest.nats_per_rev)} nats a revolution."
        )
    said += [
        f"The orbit of {name} reaches the housing, but its model has no contact: "
        "give the mode rub = true, or these figures do not hold for it."
        for name in found.touching
    ]
    said.append(
        "False alarms of a healthy machine: "
        f"at most {found.false_alarms_per_1000_rev:.2g} in 1000 revolutions."
    )
    return said


def _ambiguity(found: BankDetectability, ambiguity: Ambiguity, rpm: str, units: _Units) -> str:
    one, other = ambiguity.modes
    sentence = f"{one} and {other} cannot be told apart at {rpm}"
    if found.pair(one, other).simulated:
        return f"{sentence}; a rub is not simulated at other speeds."
    if ambiguity.opens_at_w is None or ambiguity.open_nats_per_rev is None:
        return f"{sentence}, nor at any speed within 30 % of it."
    return (
        f"{sentence}; at {units.rpm(ambiguity.opens_at_w):.6g} rpm they differ by "
        f"{_figure(ambiguity.open_nats_per_rev)} nats a revolution."
    )


def _figure(value: float) -> str:
    if math.isinf(value):
        return "-"
    return f"{value:.1f}" if abs(value) < 99.95 else f"{value:.0f}"


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None
