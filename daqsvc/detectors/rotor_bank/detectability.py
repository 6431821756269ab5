"""What the rotor bank of a machine can tell apart, before anything breaks, in the machine file's units."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, TypedDict

from daqsvc.rotor.detectability.prediction import detectability

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

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
    machine: MachineFile, settings: RotorBank, detector: RotorBankDetector, process_noise: float | None
) -> BankDetectability:
    """Detectability of the bank that the service would run for a machine file.

    Args:
        machine: the machine file.
        settings: its rotor bank.
        detector: made of that.
        process_noise: random motion of the machine itself, as PSD, normalised; None: that of the bank.

    Raises:
        ValueError: it cannot be computed of these figures.
    """
    return detectability(
        detector.bank_modes,
        noise=detector.noise,
        duration=detector.duration,
        threshold_nats=detector.rules.thresholds(len(detector.bank_modes)),
        variance_factor=detector.variance_factor if settings.calibrate_revolutions > 0 else 1.0,
        process_noise=process_noise,
        ac_coupled=machine.ac_coupled,
    )


class PairJson(TypedDict):
    """How clearly the true mode differs from one rival.

    Attributes:
        truth: name of the mode that the machine is in.
        rival: name of the other mode.
        nats_per_rev: expected evidence of the truth over the rival in a revolution.
        delay_rev: revolutions until half of all abrupt changes are declared; null if they never are.
        threshold_nats: evidence for that.
        simulated: whether these figures are from simulated runs; else they are computed.
    """

    truth: str
    rival: str
    nats_per_rev: float
    delay_rev: float | None
    threshold_nats: float
    simulated: bool


class AmbiguityJson(TypedDict):
    """Modes that look the same at this speed.

    Attributes:
        modes: names of the modes.
        nats_per_rev: the weaker of the two directions of evidence.
        opens_at_rpm: nearest speed that tells them apart; null if there is none.
        open_nats_per_rev: the weaker direction there; null without one.
        by_steady_1x: whether the other mode is seen all the same, as a change of the healthy steady 1X. Only
            a bank from a run-up does this, near the speed that it calibrated at.
    """

    modes: list[str]
    nats_per_rev: float
    opens_at_rpm: float | None
    open_nats_per_rev: float | None
    by_steady_1x: bool


class SmallestChangeJson(TypedDict):
    """The smallest change of one kind that can be seen.

    Attributes:
        fault: the kind.
        quantity: what changes.
        unit: unit of that; empty if it has none.
        healthy: the quantity of the healthy machine; null if it is not known.
        by_bank: the quantity that the bank finds within `within_rev`; null if it never does.
        by_vector: the quantity that the synchronous vector finds; null if it never does.
    """

    fault: str
    quantity: str
    unit: str
    healthy: float | None
    by_bank: float | None
    by_vector: float | None


class GroupJson(TypedDict):
    """What the bank would state of a mode that it cannot name alone.

    Attributes:
        mode: name of the mode.
        faults: its fault, and those that the bank would not tell from it.
    """

    mode: str
    faults: list[str]


class BankDetectabilityJson(TypedDict):
    """What the bank can tell apart.

    Attributes:
        machine: name of the machine.
        speed_rpm: speed that the figures are for.
        samples_per_rev: samples in a revolution.
        noise_um: noise of a sample, standard deviation.
        process_noise: how much the machine shakes of itself, normalised.
        false_alarms_per_1000_rev: bound on false alarms.
        modes: names of the modes, the healthiest first.
        pairs: every ordered pair of modes.
        ambiguous: modes that look the same at this speed.
        groups: modes of a bank from a run-up that are stated together with other faults, although their
            observers differ: a model that is nearly right moves as these do.
        smallest_change: the smallest visible change of each kind.
        within_rev: revolutions that `by_bank` is for.
        calibration_rev: revolutions that the baseline of the synchronous vector is taken from.
        touching: modes without rub whose orbits reach the housing all the same.
    """

    machine: str
    speed_rpm: float
    samples_per_rev: float
    noise_um: float
    process_noise: float
    false_alarms_per_1000_rev: float
    modes: list[str]
    pairs: list[PairJson]
    ambiguous: list[AmbiguityJson]
    groups: list[GroupJson]
    smallest_change: list[SmallestChangeJson]
    within_rev: float
    calibration_rev: float
    touching: list[str]


def as_json(
    prediction: BankDetectability, machine: str, detector: RotorBankDetector
) -> BankDetectabilityJson:
    """The figures in the units of the machine file; what is never reached is null.

    Args:
        prediction: the figures.
        machine: name of the machine that they are for.
        detector: its bank.
    """
    units = _Units(detector)
    return {
        "machine": machine,
        "speed_rpm": units.rpm(prediction.w),
        "samples_per_rev": prediction.samples_per_rev,
        "noise_um": units.um(prediction.noise),
        "process_noise": prediction.process_noise,
        "false_alarms_per_1000_rev": prediction.false_alarms_per_1000_rev,
        "modes": list(prediction.modes),
        "pairs": [
            {
                "truth": pair.truth,
                "rival": pair.rival,
                "nats_per_rev": pair.nats_per_rev,
                "delay_rev": _finite(pair.delay_rev),
                "threshold_nats": pair.threshold_nats,
                "simulated": pair.simulated,
            }
            for pair in prediction.pairs
        ],
        "ambiguous": [
            {
                "modes": list(ambiguity.modes),
                "nats_per_rev": ambiguity.nats_per_rev,
                "opens_at_rpm": None if ambiguity.opens_at_w is None else units.rpm(ambiguity.opens_at_w),
                "open_nats_per_rev": ambiguity.open_nats_per_rev,
                "by_steady_1x": ambiguity.by_steady_1x,
            }
            for ambiguity in prediction.ambiguities
        ],
        "groups": [
            {"mode": mode, "faults": list(faults)}
            for mode, faults in detector.predicted_groups().items()
            if len(faults) > 1
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
            for change in prediction.smallest
        ],
        "within_rev": prediction.within_rev,
        "calibration_rev": prediction.calibration_rev,
        "touching": list(prediction.touching),
    }


def as_text(prediction: BankDetectability, machine: str, detector: RotorBankDetector) -> str:
    """Tables and sentences for a person.

    Args:
        prediction: the figures.
        machine: name of the machine that they are for.
        detector: its bank.
    """
    units = _Units(detector)
    thresholds = sorted({pair.threshold_nats for pair in prediction.pairs})
    head = (
        f"{machine} at {units.rpm(prediction.w):.6g} rpm: {len(prediction.modes)} modes, "
        f"{prediction.samples_per_rev:.4g} samples a revolution,\n"
        f"noise {units.um(prediction.noise):.3g} um, "
        f"the machine's own process noise {prediction.process_noise:.3g}; "
        f"a mode is declared at {' or '.join(f'{nats:.3g}' for nats in thresholds)} nats"
    )
    paragraphs = [
        head,
        "Evidence in nats a revolution: the machine is in the mode of the row, against that of the column\n"
        + _matrix(prediction, lambda pair: pair.nats_per_rev),
        "Revolutions to declare the mode of the row after an abrupt change from that of the column (median)\n"
        + _matrix(prediction, lambda pair: pair.delay_rev),
    ]
    if any(pair.simulated for pair in prediction.pairs):
        paragraphs[-1] += "\n* from simulated runs of the rub; everything else is computed"
    paragraphs += [_smallest(prediction, units), "\n".join(_sentences(prediction, units, detector))]
    return "\n\n".join(paragraphs)


class _Units:
    """From normalised quantities back to those of a machine file."""

    def __init__(self, detector: RotorBankDetector) -> None:
        self._natural_frequency_hz = detector.natural_frequency_hz
        self._clearance_um = detector.clearance_um

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


def _matrix(prediction: BankDetectability, figure: Callable[[PairEvidence], float]) -> str:
    width = max(6, *(len(name) for name in prediction.modes)) + 1
    rows = ["".join(name.rjust(width) for name in ("", *prediction.modes))]
    for truth in prediction.modes:
        row = truth.rjust(width)
        for rival in prediction.modes:
            if truth == rival:
                row += ".".rjust(width)
            else:
                pair = prediction.pair(truth, rival)
                mark = "*" if pair.simulated else " "
                row += (_figure(figure(pair)) + mark).rjust(width)
        rows.append(row.rstrip())
    return "\n".join(rows)


def _smallest(prediction: BankDetectability, units: _Units) -> str:
    head = (
        "Smallest change that can be seen: by a mode of the bank made for it, half of the time within "
        f"{prediction.within_rev:.4g}\nrevolutions; and by the synchronous vector, however long it takes, "
        f"from {prediction.calibration_rev:.4g} revolutions of calibration"
    )
    rows = [
        head,
        f"{'':>34}{'healthy':>12}{'bank':>12}{'vector':>12}",
    ]
    for change in prediction.smallest:
        quantity, unit = _QUANTITIES[change.fault]
        values = (units.quantity(change, v) for v in (change.healthy, change.by_bank, change.by_vector))
        cells = ("never" if v is None else f"{v:.3g} {unit}".rstrip() for v in values)
        rows.append(f"{quantity:>34}" + "".join(f"{cell:>12}" for cell in cells))
    return "\n".join(rows)


def _sentences(prediction: BankDetectability, units: _Units, detector: RotorBankDetector) -> list[str]:
    rpm = f"{units.rpm(prediction.w):.6g} rpm"
    sentences = [_ambiguity(prediction, ambiguity, rpm, units) for ambiguity in prediction.ambiguities]
    if not sentences:
        closest = min(prediction.pairs, key=lambda pair: pair.nats_per_rev)
        sentences.append(
            f"All modes can be told apart at {rpm}; {closest.truth} and {closest.rival} are the closest, "
            f"{_figure(closest.nats_per_rev)} nats a revolution."
        )
    sentences += _groups(detector.predicted_groups(), rpm)
    sentences += [
        f"The orbit of {name} reaches the housing, but its model has no contact: "
        "give the mode rub = true, or these figures do not hold for it."
        for name in prediction.touching
    ]
    sentences.append(
        "False alarms of a healthy machine: "
        f"at most {prediction.false_alarms_per_1000_rev:.2g} in 1000 revolutions."
    )
    return sentences


def _ambiguity(prediction: BankDetectability, ambiguity: Ambiguity, rpm: str, units: _Units) -> str:
    one, other = ambiguity.modes
    sentence = f"{one} and {other} cannot be told apart at {rpm}"
    if prediction.pair(one, other).simulated:
        return f"{sentence}; a rub is not simulated at other speeds."
    nowhere = "nor at any speed within 30 % of it"
    if ambiguity.by_steady_1x:
        sentence = f"The observers take {other} for {one} at {rpm}, but it is seen in the steady 1X"
        nowhere = "and they do so at every speed within 30 % of it"
    if ambiguity.opens_at_w is None or ambiguity.open_nats_per_rev is None:
        return f"{sentence}, {nowhere}."
    return (
        f"{sentence}; at {units.rpm(ambiguity.opens_at_w):.6g} rpm they differ by "
        f"{_figure(ambiguity.open_nats_per_rev)} nats a revolution."
    )


def _groups(groups: Mapping[str, Sequence[str]], rpm: str) -> list[str]:
    """Faults that stay together, and all modes of which they do; healthy has sentences of its own."""
    together: dict[tuple[str, ...], list[str]] = {}
    for mode, stated in groups.items():
        faults = tuple(sorted({*stated} - {"normal"}))
        if len(faults) > 1:
            together.setdefault(faults, []).append(mode)
    return [
        f"{', '.join(modes)} would be called {' or '.join(faults)} at {rpm}: "
        "these faults move a rotor of two modes in nearly the same way."
        for faults, modes in together.items()
    ]


def _figure(value: float) -> str:
    if math.isinf(value):
        return "-"
    return f"{value:.1f}" if abs(value) < 99.95 else f"{value:.0f}"


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None
