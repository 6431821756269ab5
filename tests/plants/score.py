"""What the product says of the plants' records: the calibrated rotor, from raw channels to names.

Each record is read at three signal-to-noise ratios (power of the healthy orbit over that of the noise, per
sample and probe). What an engineer would state is stated: the first critical speed and the damping ratio off
a Bode plot, within 20 %, the clearance by the drawing, and how far the probes may drift.
"""

from __future__ import annotations

import json
import zlib
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
from plants.run_ups import identified
from plants.timing import PER_REV

from daqsvc.detectors.rotor_synchronous.detector import RotorSynchronousDetector
from daqsvc.diagnosis.detector import Window
from daqsvc.dsp.probes import Probe
from daqsvc.dsp.speed.keyphasor import KeyphasorProbe
from daqsvc.rotor.laval import LavalRotor
from daqsvc.rotor.synchronous.watch import WatchRules

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from daqsvc.diagnosis.record import Diagnosis
    from daqsvc.rotor.calibration.run_up import RunUpFit
    from daqsvc.rotor.calibration.two_modes import TwoModeFit

SNR_DB = (20, 10, 0)
_TOLERANCE = 0.2
_KEYPHASOR_WIDTH_RAD = 0.35
_DRIFT_UM = 1.0

ONLY_1X = frozenset({"unbalance", "damping_loss"})
"""One group at constant speed wherever the change does not tell them apart: either name is of it."""
TRUTH: dict[str, frozenset[str]] = {
    "unbalance": frozenset({"unbalance"}),
    # At one speed a bend that turns with the shaft is an unbalance, by any measure.
    "thermal bow": frozenset({"unbalance"}),
    "damping loss": frozenset({"damping_loss"}),
    "one support softer": frozenset({"stiffness_loss"}),
    "both supports softer": frozenset({"stiffness_loss"}),
    "static load": frozenset({"static_load"}),
    "light rub": frozenset({"rub"}),
    "heavy rub": frozenset({"rub"}),
}
"""Faults that have a model, by the name that is right."""
ALLOWED: dict[str, frozenset[str]] = {
    # An oil film with more room or thinner oil is softer.
    "bearing wear": frozenset({"stiffness_loss"}),
    "thin oil": frozenset({"stiffness_loss"}),
    # Each of them is a loss of stiffness: in one direction, for a part of a revolution, or at one support.
    "breathing crack": frozenset({"stiffness_loss"}),
    "asymmetric shaft": frozenset({"stiffness_loss"}),
    "looseness": frozenset({"stiffness_loss"}),
}
"""Names of modelled faults that are true of one that has no model of its own."""
MODELLED = frozenset().union(*TRUTH.values())
SURE = 0.9
CLEAR = 0.1
"""A change below this part of the healthy whirl need not get a name: twice what the product calls small."""


@dataclass(frozen=True, slots=True)
class Said:
    """What was said of a record at one signal-to-noise ratio.

    Attributes:
        case: its name.
        fault: what happened.
        snr_db: ratio.
        moved: change over the healthy whirl.
        alarms_before: departures before anything happened.
        revolutions_before: revolutions judged before anything happened.
        delay: revolutions from the onset to the departure; None if there was none.
        decision: at the end.
        group: at the end, all that cannot be told apart.
        probability: of the decision, at the end.
        probabilities: of all, at the end.
        evidence: of all, nats, at the end.
        named: whether the machine has a name for it.
        refused: why there is no baseline of the healthy machine; empty if there is.
    """

    case: str
    fault: str
    snr_db: int
    moved: float
    alarms_before: int
    revolutions_before: float
    delay: float | None
    decision: str
    group: tuple[str, ...]
    probability: float
    probabilities: dict[str, float]
    evidence: dict[str, float]
    named: bool
    refused: str

    @property
    def names(self) -> frozenset[str]:
        """All that it may be, by what was said; empty while there is no name."""
        if not self.named:
            return frozenset()
        return frozenset(self.group or (self.decision,))

    @property
    def true_names(self) -> frozenset[str]:
        """Names that are true of the fault; at one speed the pair is one."""
        truth = TRUTH.get(self.fault) or ALLOWED.get(self.fault, frozenset())
        return truth | ONLY_1X if truth & ONLY_1X else truth

    @property
    def right(self) -> bool:
        """Whether a modelled fault has its name; 1X alone may stay the group that it is."""
        return bool(self.names) and self.names <= self.true_names

    @property
    def told(self) -> bool:
        """Whether the truth is the name or in the group."""
        return bool(self.names & self.true_names)

    @property
    def misnamed(self) -> bool:
        """Whether a fault without a model has, as good as certain, a name that is not true of it."""
        if not self.named or self.names & {"unmodelled", "small_change"}:
            return False
        others = MODELLED - ALLOWED.get(self.fault, frozenset()) - ONLY_1X
        chances = [sum(self.probabilities.get(name, 0.0) for name in ONLY_1X)]
        return max(*chances, *(self.probabilities.get(name, 0.0) for name in others)) >= SURE

    @property
    def wrong(self) -> bool:
        """Whether there is a name, and the truth is not in it."""
        return self.named and not self.told and not self.names & {"unmodelled", "small_change"}


def samples_of(record: Path, snr_db: int, onset_rev: float, seed: int) -> NDArray[np.float32]:
    """Two probes in um and a keyphasor in volts, float32 ``[n, 3]``, with noise."""
    with np.load(record) as kept:
        z, angle = kept["z_um"].astype(np.complex128), kept["angle_rad"]
    healthy = z[: round(onset_rev) * PER_REV]
    rng = np.random.default_rng([seed, snr_db, zlib.crc32(record.stem.encode())])
    columns = []
    for probe, before in ((z.real, healthy.real), (z.imag, healthy.imag)):
        noise = np.sqrt(before.var() / 10.0 ** (snr_db / 10.0))
        columns.append(probe + noise * rng.standard_normal(len(z)))
    columns.append(keyphasor_volts(angle, rng))
    return np.stack(columns, axis=1).astype(np.float32)


def keyphasor_volts(angle: NDArray[np.float64], rng: np.random.Generator) -> NDArray[np.float64]:
    """What a keyphasor shows: a notch that passes pulls the voltage down, and its end marks angle zero."""
    past = np.mod(angle + _KEYPHASOR_WIDTH_RAD, 2.0 * np.pi)
    edge = np.interp(
        past, [0.0, 0.1, _KEYPHASOR_WIDTH_RAD - 0.1, _KEYPHASOR_WIDTH_RAD + 0.1, 6.2], [-2, -10, -10, -2, -2]
    )
    return np.asarray(edge + 0.02 * rng.standard_normal(len(angle)))


def judge(folder: Path, seed: int, job: tuple[dict[str, object], int], *, run_up: bool = False) -> Said:
    """Run the detector over a record, with or without what the geometry's run-up shows."""
    case, snr_db = job
    onset = float(case["onset_rev"])
    healthy = case["fault"] == "healthy"
    record = folder / f"{case['name']}.npz"
    rng = np.random.default_rng([seed, 7, zlib.crc32(record.stem.encode())])
    off = 1.0 + _TOLERANCE * rng.uniform(-1.0, 1.0, 2)
    speed_rpm = float(case["speed_rpm"])
    rate_hz = speed_rpm / 60.0 * PER_REV
    stated = LavalRotor(
        natural_frequency_hz=float(case["critical_hz"]) * off[0],
        damping_ratio=float(case["damping_ratio"]) * off[1],
        clearance_um=float(case["clearance_um"]),
        plain_bearings="journals" in str(case["geometry"]),
    )
    detector = RotorSynchronousDetector(
        machine=str(case["geometry"]),
        stream="shaft",
        rate_hz=rate_hz,
        speed_rpm=speed_rpm,
        probes=(Probe("x", 0, 0.0), Probe("y", 1, 90.0)),
        reference=KeyphasorProbe("keyphasor", 2, -6.0),
        rotor=_with_run_up(stated, *identified(folder, str(case["geometry"]), seed)) if run_up else stated,
        rules=WatchRules(probe_drift_um=_DRIFT_UM),
    )
    samples = samples_of(record, snr_db, onset, seed)
    said: list[Diagnosis] = []
    for begin in range(0, len(samples), detector.block):
        part = samples[begin : begin + detector.block]
        said += detector.process(window_of(part, begin, rate_hz))
    last = detector.finish()
    return _summed(case, snr_db, [*said, *([last] if last else [])], detector.refused, onset, healthy=healthy)


def _with_run_up(stated: LavalRotor, nearest: RunUpFit, modes: TwoModeFit) -> LavalRotor:
    """As ``daqsvc calibrate`` has it: a run-up replaces what was stated where one Laval rotor explains it."""
    known = nearest.rotor(clearance_um=stated.clearance_um) if nearest.laval else stated
    return modes.beside(known)


def window_of(samples: NDArray[np.float32], first_index: int, rate_hz: float) -> Window:
    """A block of the stream."""
    period_ns = 1e9 / rate_hz
    return Window(first_index, samples, round((first_index + len(samples) - 1) * period_ns), period_ns)


def _summed(
    case: dict[str, object],
    snr_db: int,
    said: Sequence[Diagnosis],
    refused: str,
    onset: float,
    *,
    healthy: bool,
) -> Said:
    until = np.inf if healthy else onset
    before, alarms, delay = "", 0, None
    for diagnosis in said:
        at = diagnosis.end_index / PER_REV
        # A machine that has already been called changed does not depart once more when it gets a name.
        changed = diagnosis.decision not in {"undetermined", "normal"}
        left = before in {"", "undetermined", "normal"} and changed
        if left and at <= until:
            alarms += 1
        elif at > until and delay is None and changed:
            delay = max(0.0, at - onset)
        before = diagnosis.decision
    end = said[-1]
    first = next((d.end_index / PER_REV for d in said if d.decision != "undetermined"), np.inf)
    late = refused or ("" if first <= until else "the baseline was made after the onset")
    judged = max(0.0, (float(end.revolutions or 0.0) if healthy else onset) - 50.0)
    return Said(
        case=str(case["name"]),
        fault=str(case["fault"]),
        snr_db=snr_db,
        moved=float(case["moved"]),
        alarms_before=alarms,
        revolutions_before=0.0 if late else judged,
        delay=delay,
        decision=end.decision,
        group=tuple(str(name) for name in end.group),
        probability=float(end.probabilities.get(end.decision, 0.0)),
        probabilities=dict(end.probabilities),
        evidence=dict(end.evidence),
        named=end.decision not in {"undetermined", "normal", "departure"},
        refused=late,
    )


def scored(
    folder: Path, *, part: str, seed: int = 0, snr_db: Sequence[int] = SNR_DB, run_up: bool = False
) -> list[Said]:
    """Judge all records of one part, with or without what the run-ups show."""
    cases = json.loads((folder / "cases.json").read_text())
    jobs = [(case, snr) for case in cases if case["part"] == part for snr in snr_db]
    with ProcessPoolExecutor(2) as pool:
        return list(pool.map(partial(judge, folder, seed, run_up=run_up), jobs, chunksize=8))
