"""The calibrated rotor as a detector: two proximity probes in, what has changed since calibration out."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from daqsvc.detectors.rotor_synchronous.revolutions import Revolution, RevolutionStream, SpeedReference
from daqsvc.detectors.rotor_synchronous.statements import DEPARTURE, UNDETERMINED, Standing, Stater
from daqsvc.detectors.rotor_synchronous.vector_checks import (
    VectorChecks,
    speed_verdict,
    static_position_missing,
)
from daqsvc.diagnosis.record import Diagnosis, silence_reason
from daqsvc.dsp.probes import Probe
from daqsvc.dsp.quality.probes import RevolutionJudge, RevolutionQuality
from daqsvc.dsp.quality.unit import RESCALE, beyond_any_unit
from daqsvc.dsp.speed.keyphasor import KeyphasorProbe
from daqsvc.rotor.synchronous.signatures import naming_of
from daqsvc.rotor.synchronous.watch import RotorWatch, WatchReport, WatchRules

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from daqsvc.diagnosis.detector import Window
    from daqsvc.dsp.quality.missing import EdgeCounts
    from daqsvc.rotor.laval import LavalRotor
    from daqsvc.rotor.synchronous.baseline import Calibration
    from daqsvc.rotor.synchronous.vectors import SynchronousVectors

__all__ = [
    "DEPARTURE",
    "UNDETERMINED",
    "KeyphasorProbe",
    "Probe",
    "RotorSynchronousDetector",
    "SpeedReference",
]

_WINDOW_S = 0.05
"""How often a fast shaft is evaluated, several revolutions at a time; a slow one at every revolution."""
_DEAD = 0.05
"""A probe that moves less than this part of what it did when it was calibrated is dead."""
_BLIND_REVOLUTIONS = 8.0
"""Longest time without a revolution, at the stated speed; the cutters need up to five and a half."""
_ORBIT_LOCK_REVOLUTIONS = 20.0
"""The same of the orbit cutter, which has to find the speed first."""
_OVERSPEED = 2.0
"""Multiple of its stated speed at which no machine turns; pulses at this rate are noise."""
_NO_MEAN_UM = 1e6
"""A drift of the probes beside which no mean position is evidence of anything."""
_DOUBTED = 2
"""Number of the last few revolutions that must be bad before the statement is not good."""
_REMEMBERED = 4
_REACH = 256
"""Revolutions whose ends are kept, so that an onset can be placed in the stream."""


class RotorSynchronousDetector:
    """States whether a rotor has changed since it was calibrated, and to what; see `Detector`.

    The first revolutions, or a calibration of an earlier time, are the healthy machine. Each later one is
    compared with them: a change is declared at once, as decision ``departure``, and named when the rotor has
    settled (`RotorWatch`). Decisions are ``undetermined`` while calibrating, ``normal``, ``departure``
    between a change and its first name, and then the verdict: ``unbalance``, ``damping_loss``,
    ``static_load``, ``stiffness_loss``, ``rub``, ``unmodelled`` (none of them) or ``small_change`` (below
    the size that gets a name). What the evidence cannot tell apart is the group; among the members of one
    group the decision does not move. ``evidence`` holds nats of every hypothesis over "no change".

    Severity: any change is alert; a rub, and a change larger than the healthy whirl itself, is danger.

    One `Diagnosis` a revolution at most: when something changes, at each look at a change, and else once a
    second. A revolution with missing samples, a dead or clipped probe, an unknown angle, or a speed
    farther than 5 % from the calibrated one is not judged. The decision is held and the reason stated. A
    calibration that is refused is a quality that is not good, with the reason, until one succeeds.

    A shaft that turns clockwise is viewed from its other end (x mirrored): its whirl is then forward, and
    gravity still points down. Statistics are in the machine's own coordinates.

    With AC-coupled probes the mean position shows nothing and is left out. A static load cannot be seen,
    stiffness loss is hard to tell from unbalance, and rub and an unmodelled change stay one group. The same
    is assumed if the calibrated mean position is zero where the shaft's weight must bend it.

    Args:
        machine: name of the machine.
        stream: name of the stream with all sensors.
        rate_hz: sampling rate.
        speed_rpm: stated speed; negative if the shaft turns clockwise.
        probes: two proximity probes.
        reference: what gives the shaft angle. ``"fixed"``: the stated speed is exact, the first sample is
            angle zero. ``"orbit"``: the angle follows the orbit's 1X; a slow turn of its phase is not seen.
        rotor: what is known about the rotor.
        rules: thresholds. The margins of a name follow from what is known of the rotor (`naming_of`).
        calibration: of an earlier time; made of the first revolutions if not given.
        ac_coupled: whether the probes show no static position.
        name: name of the detector.
        listener: called with every report of the watch and the revolution that it is about, in the
            coordinates of the watch; for plots.
        keep: called with the baseline that was made of the first revolutions, and with each that has learnt
            more of how 1X follows the speed, on the detector's thread.

    Raises:
        ValueError: a figure cannot be, or the probes look in nearly the same direction.
    """

    def __init__(
        self,
        *,
        machine: str,
        stream: str,
        rate_hz: float,
        speed_rpm: float,
        probes: tuple[Probe, Probe],
        reference: SpeedReference,
        rotor: LavalRotor,
        rules: WatchRules | None = None,
        calibration: Calibration | None = None,
        ac_coupled: bool = False,
        name: str = "rotor-synchronous",
        listener: Callable[[WatchReport, SynchronousVectors], None] | None = None,
        keep: Callable[[Calibration], None] | None = None,
    ) -> None:
        self._turns = RevolutionStream(
            machine=machine, rate_hz=rate_hz, speed_rpm=speed_rpm, probes=probes, reference=reference
        )
        self.name = name
        self.stream = stream
        turns = max(1.0, _WINDOW_S * abs(speed_rpm) / 60.0)
        self.block = max(1, round(self._turns.period * turns))
        self.ac_coupled = ac_coupled or (calibration is not None and static_position_missing(calibration))
        self._rate_hz = rate_hz
        self._reference = reference
        known = rotor if calibration is None else calibration.rotor
        self._rules = replace(rules or WatchRules(), naming=naming_of(known))
        self._listener = listener
        self._keep = keep
        self._judge = RevolutionJudge(probes)
        self._checks = VectorChecks(probes, self._turns.axes_deg, angle_assumed=reference == "fixed")
        self._stater = Stater(
            machine=machine,
            detector=name,
            stream=stream,
            sensors=tuple(sensor.name for sensor in self._turns.sensors),
            clockwise=self._turns.clockwise,
            rate_hz=rate_hz,
            rules=self._rules,
        )
        self._watch = self._new_watch(rotor, calibration)
        self._report: WatchReport | None = None
        self._refused = ""
        self._t_end_ns = 0
        self._period_ns = 0.0
        self._volts_unfit, self._volts_unfit_until = "", 0
        self._verdicts: deque[RevolutionQuality] = deque(maxlen=_REMEMBERED)
        self._ends: deque[int] = deque(maxlen=_REACH)
        self._speed_rpm = self._stated_rpm = abs(speed_rpm)
        self._taken = self._missing = 0
        self._missing_share: float | None = None

    @property
    def watch(self) -> RotorWatch:
        """The watch, with its calibration; another one when a baseline turned out to be none."""
        return self._watch

    @property
    def refused(self) -> str:
        """Why the revolutions so far could not be the baseline; empty if they could."""
        return self._watch.refused or self._refused

    @property
    def edges(self) -> EdgeCounts:
        """What became of the keyphasor's pulses."""
        return self._turns.edges

    def warm(self) -> None:
        """See `Detector.warm`; there is nothing to compile."""

    def process(self, window: Window) -> Sequence[Diagnosis]:
        """See `Detector.process`."""
        if not len(window.samples):
            return []
        return [diagnosis for part in window.parts() for diagnosis in self._process(part)]

    def _process(self, window: Window) -> list[Diagnosis]:
        """Take in a window without a break behind its first sample."""
        self._t_end_ns, self._period_ns = window.t_end_ns, window.period_ns
        self._count_missing(window)
        self._look_at_volts(window)
        broken = bool(window.breaks)
        if broken or abs(window.first_index - self._turns.end_index) > self._turns.period:
            self._judge.reset()
            self._checks.reset()
        diagnoses = [
            self._revolution(revolution)
            for revolution in self._turns.process(window.samples, window.first_index, broken=broken)
        ]
        diagnoses.append(self._blind())
        return [diagnosis for diagnosis in diagnoses if diagnosis is not None]

    def _look_at_volts(self, window: Window) -> None:
        """Whether the keyphasor reads what no sensor measures; revolutions come some time after it."""
        if not isinstance(self._reference, KeyphasorProbe):
            return
        if wrong := beyond_any_unit(window.samples[:, self._reference.column]):
            self._volts_unfit = f"{self._reference.name} {wrong}; {RESCALE}"
            end = window.first_index + len(window.samples)
            self._volts_unfit_until = end + round(_BLIND_REVOLUTIONS * self._turns.period)
        elif window.first_index >= self._volts_unfit_until:
            self._volts_unfit = ""

    def _count_missing(self, window: Window) -> None:
        """Count the samples since the last statement, and those that lack a value of any sensor."""
        columns = [sensor.column for sensor in self._turns.sensors]
        begun = self._taken > 0 or self._missing_share is not None
        gap = max(window.first_index - self._turns.end_index, 0) if begun else 0
        self._taken += gap + len(window.samples)
        self._missing += gap + int((~np.isfinite(window.samples[:, columns])).any(axis=1).sum())

    def _stating(self, diagnosis: Diagnosis | None) -> Diagnosis | None:
        """A statement with the share of samples that are missing since the last one."""
        if diagnosis is None:
            return None
        if self._taken:
            self._missing_share = self._missing / self._taken
            self._taken = self._missing = 0
        return replace(diagnosis, missing_share=self._missing_share)

    def silent(self, silence_s: float, t_ns: int) -> Sequence[Diagnosis]:
        """See `Detector.silent`."""
        verdict = RevolutionQuality("missing", silence_reason(self.stream, silence_s))
        return [self._stater.silence(self._standing(), verdict, self._turns.end_index, t_ns)]

    def finish(self) -> Diagnosis | None:
        """A last evaluation, at the end of a recording; None if there was no revolution to look at."""
        if self._report is None:
            return None
        reports = self._watch.finish()
        self._report = replace(self._report, identification=reports, looked=reports is not None)
        return self._stater.state(self._standing(), self._verdict(), *self._end(self._ends[-1]))

    def _new_watch(self, rotor: LavalRotor, calibration: Calibration | None) -> RotorWatch:
        if calibration is not None and self.ac_coupled:
            baseline = calibration.baseline.copy()
            baseline[0] = 0.0
            calibration = replace(calibration, baseline=baseline)
        rules = replace(self._rules, angle_assumed=self._reference == "fixed")
        if self.ac_coupled:
            # Where the shaft touches is told from where it runs: without that a crack can look like a rub.
            naming = replace(rules.naming, rub_margin_nats=math.inf)
            rules = replace(rules, probe_drift_um=_NO_MEAN_UM, naming=naming)
        return RotorWatch(rotor, self._rate_hz, calibration=calibration, rules=rules)

    def _revolution(self, revolution: Revolution) -> Diagnosis | None:
        """One revolution: its quality, what the watch finds in it, and what is worth reporting."""
        if self.ac_coupled:
            revolution = revolution.without_mean()
        self._speed_rpm = 60.0 * self._rate_hz / float(revolution.vector.period_samples[0])
        verdict = self._judge_revolution(revolution)
        self._verdicts.append(verdict)
        if verdict.quality != "good":
            revolution = revolution.unusable()
        before = self._watch.calibration
        calibrating = before is None
        reports = self._watch.evaluate(revolution.vector, revolution.orbit, settled=revolution.settled)
        self._ends.append(self._turns.origin + int(revolution.vector.end_index[0]))
        if calibrating and self._watch.calibration is not None:
            self._look_at_baseline(self._watch.calibration)
        elif before is not None:
            self._keep_what_was_learnt(before)
        rejected = calibrating and self._watch.calibration is None and bool(self._refused)
        if self._report is not None:
            self._report = replace(self._report, departed=False, looked=False)
        for report in [] if rejected else reports:
            self._report = report
            if self._listener is not None:
                self._listener(report, revolution.vector)
        return self._stating(
            self._stater.maybe(self._standing(), self._verdict(), *self._end(self._ends[-1]))
        )

    def _judge_revolution(self, revolution: Revolution) -> RevolutionQuality:
        """What a revolution is worth, the cheapest and clearest reason first."""
        calibration = self._watch.calibration
        least_um = 0.0
        if self._refused and not self._rules.retry:
            return RevolutionQuality("not_ok", self._refused)
        overspeed = self._speed_rpm > _OVERSPEED * self._stated_rpm
        if self._volts_unfit or not revolution.trusted or overspeed:
            return self._angle_unknown()
        if calibration is not None:
            verdict = speed_verdict(self._speed_rpm, calibration)
            if verdict.quality != "good":
                return verdict
            least_um = _DEAD * math.hypot(calibration.noise_um, calibration.amplitude_um / math.sqrt(2.0))
        verdict = self._judge.judge(revolution.raw, least_um)
        if verdict.quality != "good":
            return verdict
        if not revolution.vector.usable[0]:
            return RevolutionQuality("missing", _cannot_fit(revolution))
        self._checks.add(revolution.vector.vectors[0])
        return RevolutionQuality() if calibration is None else self._checks.judge(calibration)

    def _look_at_baseline(self, calibration: Calibration) -> None:
        """A baseline has just been made: is it one, and does it show a mean position?"""
        revolutions = self._watch.revolutions
        if reason := self._checks.of_baseline(calibration):
            self._refused = reason
            self._watch = self._new_watch(calibration.rotor, None)
        else:
            self._refused = ""
            if self._keep is not None:
                self._keep(calibration)
            if self.ac_coupled or not static_position_missing(calibration):
                return
            self.ac_coupled = True
            self._watch = self._new_watch(calibration.rotor, calibration)
        self._watch.revolutions = revolutions

    def _keep_what_was_learnt(self, before: Calibration) -> None:
        """Keep the baseline if it has learnt more of how 1X follows the speed."""
        calibration = self._watch.calibration
        if self._keep is None or calibration is None or calibration.law is before.law:
            return
        if (learnt := self._watch.learnt) is not None:
            self._keep(learnt)

    def _blind(self) -> Diagnosis | None:
        """The statement when no revolution has come out for too long."""
        slowest_rpm = min(self._speed_rpm, self._stated_rpm)
        patience = _ORBIT_LOCK_REVOLUTIONS if self._reference == "orbit" else _BLIND_REVOLUTIONS
        if self._turns.waiting_samples <= patience * 60.0 * self._rate_hz / slowest_rpm:
            return None
        end = self._end(self._turns.end_index)
        return self._stating(self._stater.maybe(self._standing(), self._angle_unknown(), *end))

    def _angle_unknown(self) -> RevolutionQuality:
        if self._volts_unfit:
            return RevolutionQuality("not_ok", self._volts_unfit)
        if isinstance(self._reference, KeyphasorProbe):
            return RevolutionQuality(
                "missing",
                f"{self._reference.name}: its pulses do not tell the shaft angle at {self._stated_rpm:.0f} "
                "rpm; check that the shaft turns at that speed, and that the pulse crosses "
                f"{self._reference.threshold_v} V",
            )
        return RevolutionQuality(
            "missing",
            f"no 1X is found in the orbit around {self._stated_rpm:.0f} rpm; check that the shaft turns at "
            "that speed, or use a keyphasor",
        )

    def _verdict(self) -> RevolutionQuality:
        """What the last revolutions are worth together."""
        doubts = [verdict for verdict in self._verdicts if verdict.quality != "good"]
        if len(doubts) >= _DOUBTED:
            return doubts[-1]
        if self.refused:
            return RevolutionQuality("not_ok", f"cannot be calibrated: {self.refused}")
        notes = ["the probes show no mean position: a static load cannot be seen"] if self.ac_coupled else []
        identification = None if self._report is None else self._report.identification
        if identification is not None and identification.by_line:
            notes.append(identification.describe_line())
        return RevolutionQuality("good", "; ".join(notes))

    def _standing(self) -> Standing:
        watch, report = self._watch, self._report
        onset_index = None
        if report is not None and report.onset_revolution is not None:
            back = watch.revolutions - report.onset_revolution + 2
            onset_index = self._ends[-back] if back <= len(self._ends) else None
        return Standing(
            report=report,
            calibration=watch.calibration,
            mean=self._checks.mean,
            speed_rpm=self._speed_rpm,
            revolutions=watch.revolutions,
            onset_index=onset_index,
        )

    def _end(self, end_index: int) -> tuple[int, int]:
        """An end of evidence with the monotonic time of the last sample before it."""
        return end_index, self._t_end_ns - round((self._turns.end_index - end_index) * self._period_ns)


def _cannot_fit(revolution: Revolution) -> str:
    """Why the samples of a revolution do not show its harmonics."""
    missing = int((~np.isfinite(revolution.raw).all(axis=1)).sum())
    if missing:
        return (
            f"{missing} of {len(revolution.raw)} samples of a revolution are missing, too many or too close "
            "together to tell its harmonics; check the bus and the device"
        )
    return f"{len(revolution.raw)} samples of a revolution are too few to tell its harmonics; sample faster"
