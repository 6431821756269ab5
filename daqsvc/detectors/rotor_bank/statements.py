"""What a rotor bank reports to the alarms: a `Diagnosis` of its report, and one of its silence."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from daqsvc.diagnosis.record import Diagnosis, Severity, silence_reason
from daqsvc.rotor.bank import UNDETERMINED

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from daqsvc.detectors.rotor_bank.modes import RotorMode
    from daqsvc.dsp.quality.probes import RevolutionQuality
    from daqsvc.rotor.bank import BankReport
    from daqsvc.rotor.decision import DecisionRules
    from daqsvc.rotor.misfit import Misfit
    from daqsvc.rotor.steady_faults import Explanation
    from daqsvc.rotor.synchronous.nonsynchronous import NonsynchronousLine

    Flags = NDArray[np.bool_]
    Floats = NDArray[np.float64]

MODEL = "laval-rotor-rub/1"

DEPARTURE = "departure"
"""Decision while the machine has left the declared mode and the cause is not yet known."""

UNDETERMINED_DECISION = "undetermined"
_UNITS = {"speed": "rpm", "line.frequency": "Hz", "line.amplitude": "um"}
_LEAST_PROBABILITY = 1e-300
_SEVERITIES: tuple[Severity, ...] = ("normal", "alert", "danger")


@dataclass(frozen=True, slots=True)
class Moment:
    """Where in the stream something is stated.

    Attributes:
        first_index: first sample of the evidence.
        end_index: one past its last sample.
        t_ns: monotonic time of that last sample.
        revolutions: of the shaft until then.
        speed_rpm: of the shaft.
    """

    first_index: int
    end_index: int
    t_ns: int
    revolutions: float
    speed_rpm: float


@dataclass(frozen=True, slots=True, kw_only=True)
class BankDiagnosisBuilder:
    """Puts a bank's reports into words.

    Attributes:
        machine: name of the machine.
        detector: name of the detector.
        stream: name of the stream.
        sensors: names of the sensors.
        modes: the modes, healthiest first.
        faults: what each mode is called.
        others: what it names besides: faults that no mode is, and ``unmodelled``.
        rules: thresholds and the rule that declares.
    """

    machine: str
    detector: str
    stream: str
    sensors: tuple[str, ...]
    modes: tuple[RotorMode, ...]
    faults: tuple[str, ...]
    others: tuple[str, ...]
    rules: DecisionRules

    def state(
        self,
        report: BankReport,
        verdict: RevolutionQuality,
        moment: Moment,
        *,
        decision: int,
        stated: str,
        changed: bool,
        off: Misfit | None,
        besides: Explanation | None,
        lines: Sequence[NonsynchronousLine],
        missing_share: float,
    ) -> Diagnosis:
        """A diagnosis.

        Args:
            report: the bank's.
            verdict: whether the samples can be trusted.
            moment: where in the stream.
            decision: index of the declared mode, -1 while undetermined.
            stated: its name, as it was last stated.
            changed: whether this states a change.
            off: how the modes miss the steady change; None where none was compared.
            besides: what else than the modes explains it; None where nothing does.
            lines: that are left out of the positions, the largest first.
            missing_share: share of the samples of the last revolution that are missing.
        """
        names = [mode.name for mode in self.modes]
        paper, departure = report.probabilities, report.departure
        probabilities = paper
        evidence: dict[str, float] = {}
        if decision != UNDETERMINED and self.rules.rule == "cusum":
            probabilities, evidence = _odds_and_evidence(report, names)
        if off is not None and decision != UNDETERMINED:
            probabilities = self._shared(probabilities, decision, off.pairs[decision])
        chances = dict(zip(names, probabilities.tolist(), strict=True))
        indices, severity = report.group, self.severity(decision, besides)
        if besides is not None and besides.is_no_mode:
            # The evidence of the modes is one for the nearest of them, not for what is stated.
            indices, evidence = (), dict(besides.evidence)
        elif departure is not None and not changed:
            indices, stated = departure.candidates, DEPARTURE
            mildest = min(_SEVERITIES.index(self.severity(i)) for i in indices)
            severity = _SEVERITIES[max(mildest, _SEVERITIES.index(severity))]
        group = tuple(names[i] for i in indices)
        if besides is not None:
            left = 1.0 - sum(besides.probabilities.values())
            chances = {name: left * p for name, p in chances.items()} | dict(besides.probabilities)
            group = tuple(dict.fromkeys((*(group or (stated,)), *besides.others)))
            group = group if len(group) > 1 else ()
        statistics = {"speed": moment.speed_rpm}
        statistics |= {f"paper.{name}": float(p) for name, p in zip(names, paper, strict=True)}
        if off is not None and not math.isnan(missed := float(off.part[decision])):
            statistics["misfit"] = missed
        if lines:
            statistics |= lines[0].figures()
        return Diagnosis(
            machine=self.machine,
            detector=self.detector,
            t_ns=moment.t_ns,
            stream=self.stream,
            first_index=moment.first_index,
            end_index=moment.end_index,
            decision=stated,
            changed=changed,
            severity=severity,
            probabilities=chances | {name: 0.0 for name in self.others if name not in chances},
            group=group,
            statistics=statistics,
            units={name: unit for name, unit in _UNITS.items() if name in statistics},
            thresholds={
                "cusum": self.rules.threshold_nats,
                "cusum.back": self.rules.back_threshold_nats,
                "probability": self.rules.probability_threshold,
            },
            evidence=evidence,
            revolutions=moment.revolutions,
            quality=verdict.quality,
            reason=verdict.reason or "; ".join(line.describe(left_out=True) for line in lines),
            sensors=self.sensors,
            model=MODEL,
            missing_share=missing_share,
        )

    def silence(
        self,
        silence_s: float,
        stated: str,
        severity: Severity,
        index: int,
        t_ns: int,
        revolutions: float,
    ) -> Diagnosis:
        """That there are no samples.

        Args:
            silence_s: for how long.
            stated: the decision that is held.
            severity: of it.
            index: the sample that would be next.
            t_ns: now.
            revolutions: of the shaft until the last sample.
        """
        return Diagnosis(
            machine=self.machine,
            detector=self.detector,
            t_ns=t_ns,
            stream=self.stream,
            first_index=index,
            end_index=index,
            decision=stated,
            severity=severity,
            revolutions=revolutions,
            quality="missing",
            reason=silence_reason(self.stream, silence_s),
            sensors=self.sensors,
            model=MODEL,
        )

    def _shared(self, probabilities: Floats, decision: int, together: Flags) -> Floats:
        """Equal parts for the faults that are not told apart: what favours one is the model's error."""
        if not together.any():
            return probabilities
        faults = np.array(self.faults)
        alike = together | (faults == faults[decision])
        names = dict.fromkeys(faults[alike].tolist())
        shared = probabilities.copy()
        for name in names:
            levels = alike & (faults == name)
            odds = np.where(levels, np.maximum(probabilities, _LEAST_PROBABILITY), 0.0)
            shared[levels] = (odds / odds.sum())[levels] * probabilities[alike].sum() / len(names)
        return shared

    def severity(self, mode: int, besides: Explanation | None = None) -> Severity:
        """How bad a declared mode is; the paper's rule raises no alarm.

        A change that no mode explains is as bad as the nearest of them, and at least an alert.
        """
        known = mode != UNDETERMINED and self.rules.rule == "cusum"
        severity = self.modes[mode].severity if known else "normal"
        outside = besides is not None and besides.is_no_mode
        return "alert" if outside and severity == "normal" else severity


def _odds_and_evidence(report: BankReport, names: Sequence[str]) -> tuple[Floats, dict[str, float]]:
    """Posterior probabilities of the modes by the evidence of the declared one over each; that evidence."""
    decision, against = report.decision, report.lead_nats
    lead, cusum = against.tolist(), report.cusum_nats.tolist()
    against[decision] = 0.0  # it leads itself by infinity in the report
    odds = np.exp(against.min() - against)
    others = [i for i in range(len(names)) if i != decision]
    evidence = {f"lead.{names[i]}": lead[i] for i in others} | {f"cusum.{names[i]}": cusum[i] for i in others}
    return np.asarray(odds / odds.sum(), dtype=np.float64), evidence
