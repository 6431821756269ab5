"""What the live bank says of the plants' machines, its observers identified from their run-up.

The run-up is read in noise of 20 dB, once for each geometry; then every record at three noise levels.
Stated is what an engineer would state: sag by the natural frequency, the clearance by the drawing, and levels
of each fault that need not be the true ones. The delay is compared with that of a test that is told when the
change comes: the same observers' evidence, summed from that sample on.
"""

from __future__ import annotations

import json
import math
import zlib
from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import TYPE_CHECKING

import numpy as np
from plants.run_ups import identified
from plants.score import (
    ALLOWED,
    CLEAR,
    MODELLED,
    ONLY_1X,
    SNR_DB,
    SURE,
    TRUTH,
    keyphasor_volts,
    window_of,
)
from plants.timing import ONSET_REV, PER_REV

from daqsvc.detectors.rotor_bank.detector import RotorBankDetector
from daqsvc.detectors.rotor_bank.modes import RotorMode, bank_modes
from daqsvc.dsp.probes import Probe
from daqsvc.dsp.speed.keyphasor import KeyphasorProbe
from daqsvc.rotor import coupled_kernels
from daqsvc.rotor.coupled import couple, state_matrix
from daqsvc.rotor.decision import DecisionRules
from daqsvc.rotor.discretise import discretise
from daqsvc.rotor.laval import STANDARD_GRAVITY_M_S2
from daqsvc.rotor.model import RotorParameters
from daqsvc.rotor.synchronous.vectors import HARMONICS

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    Case = dict[str, object]

_CALIBRATED_REV = 200
_RULES = DecisionRules(settle_revolutions=4.0)
_STATOR, _FRICTION = 2.0, 0.1
_LEVELS: dict[str, tuple[float, ...]] = {
    "unbalance": (1.4, 1.8, 2.5),
    "damping_loss": (0.7, 0.5, 0.35),
    "stiffness_loss": (0.97, 0.94, 0.9, 0.85, 0.8, 0.75, 0.7, 0.6),
    "static_load": (0.5, 1.0),
    "rub": (4.5, 5.5),
}
_TRUE = {**TRUTH, **ALLOWED, **{fault: frozenset({fault}) for fault in _LEVELS}}
"""Names that are true of a fault."""
_WITHOUT_SNR_DB = 10
"""Ratio at which banks are judged that have no mode of the fault."""
_SETTLING_REV = 30
"""Revolutions of a told test's observers before the change."""


@dataclass(frozen=True, slots=True)
class BankSaid:
    """What the bank said of a record at one signal-to-noise ratio.

    Attributes:
        case: its name.
        geometry: of the machine.
        fault: what happened.
        snr_db: ratio.
        without: whether the bank has no mode of the fault.
        false_alarms: departures before anything happened.
        revolutions_before: revolutions before anything happened.
        chances: probability of each name at the end, levels of a fault together.
        fault_said: what it says at the end; empty without a name.
        group: all that it may be, by what was said at the end.
        delay: revolutions from the change to the departure; None if there was none.
        told_delay: the same of a test that is told when the change comes.
        onset_error: revolutions that the stated onset is late.
        predicted: whether the bank predicts that it names every level of the fault alone.
        moved: change of the orbit's synchronous vector over the healthy whirl, settled, without noise.
    """

    case: str
    geometry: str
    fault: str
    snr_db: int
    without: bool
    false_alarms: int
    revolutions_before: float
    chances: Mapping[str, float]
    fault_said: str
    group: tuple[str, ...]
    delay: float | None
    told_delay: float | None
    onset_error: float | None
    predicted: bool
    moved: float

    @property
    def clear(self) -> bool:
        """Whether the change is large enough to be named, as of the calibrated rotor."""
        return self.moved >= CLEAR

    @property
    def true_names(self) -> frozenset[str]:
        """Names that are true of the fault; unbalance and damping loss count as one, as elsewhere."""
        truth = _TRUE.get(self.fault, frozenset())
        return truth | ONLY_1X if truth & ONLY_1X else truth

    @property
    def right(self) -> bool:
        """Whether it has its name, and no other."""
        return self.fault_said in self.true_names and set(self.group) <= self.true_names

    @property
    def told(self) -> bool:
        """Whether what happened is among what was said."""
        return bool(self.true_names.intersection(self.group))

    @property
    def wrong(self) -> bool:
        """Whether it has a name, and what happened is not among what it may be."""
        return self.fault_said not in {"", "healthy"} and not self.told

    @property
    def chance(self) -> float:
        """Probability of the name; that of the pair where 1X alone cannot tell."""
        return sum(
            self.chances.get(name, 0.0)
            for name in (ONLY_1X if self.fault_said in ONLY_1X else {self.fault_said})
        )

    @property
    def first_is_true(self) -> bool:
        """Whether the name is true."""
        return self.fault_said in self.true_names

    @property
    def misnamed(self) -> bool:
        """Whether a fault without a model has, as good as certain, a name that is not true of it."""
        if self.fault_said in {"", "healthy"} or "unmodelled" in self.group:
            return False
        others = MODELLED - ALLOWED.get(self.fault, frozenset()) - ONLY_1X
        chances = [sum(self.chances.get(name, 0.0) for name in ONLY_1X)]
        return max(*chances, *(self.chances.get(name, 0.0) for name in others)) >= SURE

    @property
    def alone(self) -> bool:
        """Whether it is what happened, and nothing else; a healthy machine may look like a fault."""
        return self.fault_said == self.fault and (self.fault == "healthy" or set(self.group) == {self.fault})

    @property
    def other(self) -> bool:
        """Whether it has a name, and what happened is not in the group by its own name."""
        return self.fault_said not in {"", "healthy"} and self.fault not in self.group


def _modes(rotor: RotorParameters, speed_rpm: float, whirl_um: float) -> list[RotorMode]:
    """Levels of every fault; without those that the machine cannot run in, as it would whirl by itself."""
    damping_ratio = rotor.damping_ratio
    made = {
        "unbalance": lambda name, level: RotorMode(name, unbalance_ratio=level),
        "damping_loss": lambda name, level: RotorMode(name, damping_ratio=level * damping_ratio),
        "stiffness_loss": lambda name, level: RotorMode(name, stiffness_ratio=level),
        "static_load": lambda name, level: RotorMode(name, static_load_um=(0.0, -level * whirl_um)),
        "rub": lambda name, level: RotorMode(name, unbalance_ratio=level, rub=True),
    }
    modes = [RotorMode("healthy 0")] + [
        made[fault](f"{fault} {number}", level)
        for fault, levels in _LEVELS.items()
        for number, level in enumerate(levels, 1)
    ]
    rotors = [one.rotor for one in bank_modes(modes, rotor, speed_rpm)]
    return [
        mode
        for mode, one in zip(modes, rotors, strict=True)
        if np.linalg.eigvals(state_matrix(one, one.w)).real.max() < 0.0
    ]


@dataclass(frozen=True, slots=True)
class _Shaft:
    """A machine at a speed: what its records have in common."""

    geometry: str
    speed_rpm: float
    clearance_um: float
    whirl_um: float

    @staticmethod
    def of(case: Case, z: NDArray[np.complex128], angle: NDArray[np.float64]) -> _Shaft:
        speed_rpm, clearance_um = (float(case[name]) for name in ("speed_rpm", "clearance_um"))  # type: ignore[arg-type]
        whirl_um = float(case.get("whirl_um") or np.linalg.norm(_vector(z, angle, _BEFORE)[1:]))  # type: ignore[arg-type]
        return _Shaft(str(case["geometry"]), speed_rpm, clearance_um, whirl_um)

    @property
    def rate_hz(self) -> float:
        return self.speed_rpm / 60.0 * PER_REV


def _detector(
    folder: Path, seed: int, shaft: _Shaft, noise_um: float, without: str = ""
) -> RotorBankDetector:
    """The bank of a machine at a speed, made from the run-up; `without` the modes of a fault."""
    _, fit = identified(folder, shaft.geometry, seed)
    rotor = fit.rotor(
        RotorParameters(
            natural_frequency_hz=fit.natural_frequency_hz,
            damping_ratio=fit.damping_ratio,
            eccentricity_um=1.0,
            clearance_um=shaft.clearance_um,
            static_sag_um=1e6 * STANDARD_GRAVITY_M_S2 / (math.tau * fit.natural_frequency_hz) ** 2,
            contact_stiffness=_STATOR,
            friction=_FRICTION,
            plain_bearings="journals" in shaft.geometry,
        )
    )
    return RotorBankDetector(
        machine=shaft.geometry,
        stream="shaft",
        rate_hz=shaft.rate_hz,
        speed_rpm=shaft.speed_rpm,
        probes=(Probe("x", 0, 0.0), Probe("y", 1, 90.0)),
        keyphasor=KeyphasorProbe("keyphasor", 2, -6.0),
        rotor=rotor,
        modes=[
            mode
            for mode in _modes(rotor, shaft.speed_rpm, shaft.whirl_um)
            if mode.name.rsplit(" ", 1)[0] != without
        ],
        noise_um=noise_um,
        calibrate_revolutions=_CALIBRATED_REV,
        rules=_RULES,
    )


@lru_cache(maxsize=8)
def _predicted(folder: Path, seed: int, shaft: _Shaft, snr_db: int) -> Mapping[str, tuple[str, ...]]:
    """What the bank predicts that it says of each mode, in noise by the healthy whirl."""
    noise_um = shaft.whirl_um / math.sqrt(2.0) / 10.0 ** (snr_db / 20.0)
    return _detector(folder, seed, shaft, noise_um).predicted_groups()


def judge_bank(folder: Path, seed: int, job: tuple[Case, int, bool]) -> BankSaid:
    """Run the bank over a record: at a ratio, and without the modes of its fault or with them."""
    case, snr_db, without = job
    fault = str(case["fault"])
    with np.load(folder / f"{case['name']}.npz") as kept:
        z, angle = kept["z_um"].astype(np.complex128), kept["angle_rad"]
    moved = _moved(z, angle)
    rng = np.random.default_rng([seed, snr_db, zlib.crc32(str(case["name"]).encode())])
    noise_um = math.sqrt(float(np.var(z[: ONSET_REV * PER_REV])) / 2.0 / 10.0 ** (snr_db / 10.0))
    z = z + noise_um * (rng.standard_normal(len(z)) + 1j * rng.standard_normal(len(z)))
    samples = np.stack((z.real, z.imag, keyphasor_volts(angle, rng)), axis=1).astype(np.float32)
    shaft = _Shaft.of(case, z, angle)
    detector = _detector(folder, seed, shaft, noise_um, fault if without else "")
    rate_hz = shaft.rate_hz
    predicted = {} if without or fault not in _LEVELS else _predicted(folder, seed, shaft, snr_db)
    healthy_rev = len(z) / PER_REV if fault == "healthy" else float(ONSET_REV)
    alarms, delay, onset, before, end = 0, None, None, "", None
    for begin in range(0, len(samples), detector.block):
        for said in detector.process(window_of(samples[begin : begin + detector.block], begin, rate_hz)):
            at = said.end_index / PER_REV
            changed = said.decision not in {"undetermined", "healthy 0"}
            if changed and before in {"", "undetermined", "healthy 0"}:
                if at <= healthy_rev:
                    alarms += 1
                elif delay is None:
                    delay, onset = at - ONSET_REV, said.first_index / PER_REV - ONSET_REV
            before, end = said.decision, said
    assert end is not None
    chances: Counter[str] = Counter()
    for name, probability in end.probabilities.items():
        chances[name.rsplit(" ", 1)[0]] += probability
    group = dict.fromkeys(name.rsplit(" ", 1)[0] for name in (end.decision, *map(str, end.group)))
    return BankSaid(
        case=str(case["name"]),
        geometry=str(case["geometry"]),
        fault=fault,
        snr_db=snr_db,
        without=without,
        false_alarms=alarms,
        revolutions_before=healthy_rev,
        chances=chances,
        fault_said="" if end.decision in {"undetermined", "departure"} else end.decision.rsplit(" ", 1)[0],
        group=tuple(name for name in group if name not in {"undetermined", "departure"}),
        delay=delay,
        told_delay=_told_delay(detector, z, angle, fault) if fault in _LEVELS else None,
        onset_error=onset,
        predicted={stated for mode, stated in predicted.items() if mode.rsplit(" ", 1)[0] == fault}
        == {(fault,)},
        moved=moved,
    )


_BEFORE = slice(20 * PER_REV, (ONSET_REV - 10) * PER_REV)


def _vector(z: NDArray[np.complex128], angle: NDArray[np.float64], part: slice) -> NDArray[np.complex128]:
    return np.array([np.mean(z[part] * np.exp(-1j * k * angle[part])) for k in HARMONICS])


def _moved(z: NDArray[np.complex128], angle: NDArray[np.float64]) -> float:
    """Change of the synchronous vector over the healthy whirl, from well before the onset to the end."""
    before, after = (_vector(z, angle, part) for part in (_BEFORE, slice(len(z) - 80 * PER_REV, len(z))))
    return float(np.linalg.norm(after - before) / np.linalg.norm(before[1:]))


def _told_delay(
    detector: RotorBankDetector, z: NDArray[np.complex128], angle: NDArray[np.float64], fault: str
) -> float | None:
    """Revolutions until the evidence of any level of the fault, summed from the change on, is enough.

    None if it never is, or if the bank has no level of it: the machine would whirl by itself.
    """
    modes = [m for m in detector.bank_modes if m.name.rsplit(" ", 1)[0] in {"healthy", fault}]
    if len(modes) < 2:
        return None
    figures = {
        "noise": detector.noise,
        "duration": detector.duration,
        "variance_factor": detector.variance_factor,
    }
    observers = discretise(modes, **figures)
    couplings = couple(modes, observers, **figures)
    part = slice((ONSET_REV - _SETTLING_REV) * PER_REV, None)
    clearance = detector.clearance_um
    xy = np.column_stack((z[part].real, z[part].imag)) / clearance
    states, scores = np.zeros((len(modes), 4)), np.empty((len(modes), len(xy)))
    states[observers["substeps"] > 0] = np.nan
    cos, sin = np.cos(angle[part]), np.sin(angle[part])
    coupled_kernels.run_free(xy, cos, sin, observers, couplings, states, scores)
    evidence = np.cumsum((scores[1:] - scores[0])[:, _SETTLING_REV * PER_REV :], axis=1).max(axis=0)
    passed = np.flatnonzero(evidence >= _RULES.threshold_nats)
    return float(passed[0] + 1) / PER_REV if len(passed) else None


def bank_summary(said: Sequence[BankSaid]) -> list[str]:
    """One row for every ratio."""
    columns = (
        "SNR",
        "right",
        "told",
        "wrong",
        "true of p >= 0.9",
        "alone",
        "another",
        "alone, of predicted",
        "not seen",
        "healthy right",
        "false alarms",
        "onset off",
        "delay ratio",
    )
    lines = [f"| {' | '.join(columns)} |", "|---" * len(columns) + "|"]
    for snr in SNR_DB:
        at = [one for one in said if one.snr_db == snr]
        faults = [one for one in at if one.fault != "healthy"]
        clear = [one for one in faults if one.clear]
        sure = [one for one in clear if one.chance >= SURE and one.fault_said not in {"", "healthy"}]
        predicted = [one for one in faults if one.predicted]
        healthy = [one for one in at if one.fault == "healthy"]
        both = [one.delay / one.told_delay for one in faults if one.delay and one.told_delay]
        off = [abs(one.onset_error) for one in faults if one.onset_error is not None]

        lines.append(
            f"| {snr} dB | {_share(lambda one: one.right, clear)} | {_share(lambda one: one.told, clear)} | "
            f"{_share(lambda one: one.wrong, clear)} of {len(clear)} | "
            f"{_share(lambda one: one.first_is_true, sure)} of {len(sure)} | "
            f"{_share(lambda one: one.alone, faults)} | {_share(lambda one: one.other, faults)} | "
            f"{_share(lambda one: one.alone, predicted)} of {len(predicted)} | "
            f"{_share(lambda one: one.delay is None, faults)} of {len(faults)} | "
            f"{_share(lambda one: one.alone, healthy)} | "
            f"{sum(one.false_alarms for one in at)} in {sum(one.revolutions_before for one in at):.0f} "
            "revolutions | "
            f"{np.median(off):.2f} rev | {np.median(both):.2f} |"
        )
    return lines


def bank_answers(said: Sequence[BankSaid], snr_db: int) -> list[str]:
    """What each fault is called on each machine at one ratio."""
    lines = [f"| machine, {snr_db} dB | " + " | ".join(_LEVELS) + " |", "|---|" + "---|" * len(_LEVELS)]
    at = [one for one in said if one.snr_db == snr_db]
    for machine in dict.fromkeys(one.geometry for one in at):
        cells = []
        for fault in _LEVELS:
            runs = [one for one in at if (one.geometry, one.fault) == (machine, fault)]
            found = Counter(" or ".join(sorted(one.group)) or "departure" for one in runs)
            told = ", ".join(f"{name.replace('_', ' ')} {count}" for name, count in found.most_common())
            cells.append(told)
        lines.append(f"| {machine} | " + " | ".join(cells) + " |")
    return lines


def bank_beside(others: Sequence[BankSaid], without: Sequence[BankSaid]) -> list[str]:
    """What a bank says of what it has no mode of, and of healthy machines that drift and hunt.

    Args:
        others: of faults that no mode is made for, and of healthy machines.
        without: of faults of which the bank has no mode.
    """
    columns = ("SNR", "unmodelled: misnamed", "named unmodelled", "false alarms / 1000 rev")
    lines = [f"| {' | '.join(columns)} |", "|---" * len(columns) + "|"]
    for snr in SNR_DB:
        at = [one for one in others if one.snr_db == snr]
        faults = [one for one in at if one.fault != "healthy" and one.clear]
        revolutions = sum(one.revolutions_before for one in at)
        alarms = sum(one.false_alarms for one in at)
        lines.append(
            f"| {snr} dB | {_share(lambda one: one.misnamed, faults)} of {len(faults)} | "
            f"{_share(lambda one: 'unmodelled' in one.group, faults)} | "
            f"{1000.0 * alarms / revolutions:.2f} ({revolutions:.0f} rev) |"
        )
    clear = [one for one in without if one.clear]
    lines += [
        "",
        f"| without modes of the fault, {_WITHOUT_SNR_DB} dB | right | told | wrong |",
        "|---|---|---|---|",
    ]
    for fault in _LEVELS:
        runs = [one for one in clear if one.fault == fault]
        lines.append(
            f"| {fault.replace('_', ' ')} | {_share(lambda one: one.right, runs)} | "
            f"{_share(lambda one: one.told, runs)} | {_share(lambda one: one.wrong, runs)} of {len(runs)} |"
        )
    return lines


def _share(of: Callable[[BankSaid], bool], runs: Sequence[BankSaid]) -> str:
    return f"{100.0 * sum(map(of, runs)) / len(runs):.1f} %"


def bank_scored(folder: Path, *, part: str, seed: int = 0, snr_db: Sequence[int] = SNR_DB) -> list[BankSaid]:
    """Judge all records of one part: its own, those of faults without a mode, and banks without modes."""
    own, all_cases = (json.loads((folder / file).read_text()) for file in ("bank.json", "cases.json"))
    jobs = [(case, snr, False) for case in own if case["part"] == part for snr in snr_db]
    jobs += [
        (case, _WITHOUT_SNR_DB, True)
        for case in own
        if case["part"] == part and case["fault"] != "healthy" and _WITHOUT_SNR_DB in snr_db
    ]
    jobs += [
        (case, snr, False)
        for case in all_cases
        if case["part"] == part and case["fault"] not in TRUTH
        for snr in snr_db
    ]
    with ProcessPoolExecutor(2) as pool:
        return list(pool.map(partial(judge_bank, folder, seed), jobs, chunksize=11))


def parts_of(said: Sequence[BankSaid]) -> tuple[list[BankSaid], list[BankSaid], list[BankSaid]]:
    """Of the bank's own records, of faults without a model and other healthy machines, and without modes."""
    own = [one for one in said if one.case.startswith("bank-") and not one.without]
    without = [one for one in said if one.without]
    return own, [one for one in said if not one.case.startswith("bank-")], without
