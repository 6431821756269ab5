"""The rotor bank as a detector: two proximity probes and a keyphasor in, the rotor's mode out."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from daqsvc.detectors.rotor_bank.modes import RotorMode, bank_modes, fault_of, named_besides
from daqsvc.detectors.rotor_bank.orbit_checks import OrbitWatch
from daqsvc.detectors.rotor_bank.statements import (
    DEPARTURE,
    UNDETERMINED_DECISION,
    BankDiagnosisBuilder,
    Moment,
)
from daqsvc.dsp.probes import Probe
from daqsvc.dsp.quality.missing import OBSERVED_SHARE
from daqsvc.dsp.quality.probes import DEAD, RevolutionJudge, RevolutionQuality
from daqsvc.dsp.quality.sound import is_sound
from daqsvc.dsp.quality.stuck import stands_still
from daqsvc.dsp.quality.unit import RESCALE, beyond_any_unit
from daqsvc.dsp.speed.keyphasor import KeyphasorProbe, KeyphasorTracker
from daqsvc.rotor.adaptation import MODEL_ERROR, VARIANCE_FACTOR, SteadyFit, adapted
from daqsvc.rotor.bank import UNDETERMINED, BankReport, ModelBank
from daqsvc.rotor.decision import DecisionRules
from daqsvc.rotor.line_removal import LineRemoval
from daqsvc.rotor.misfit import (
    Misfit,
    SteadyChange,
    SteadyMotions,
    hunting,
    misfit,
    steady_baseline,
    steady_change,
    swing,
)
from daqsvc.rotor.steady_faults import Explanation, SteadyFaults, narrowed
from daqsvc.rotor.synchronous.nonsynchronous import HealthyOrbit

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from daqsvc.diagnosis.detector import Window
    from daqsvc.diagnosis.record import Diagnosis
    from daqsvc.rotor.discretise import BankMode
    from daqsvc.rotor.model import NormalisedRotor, RotorParameters
    from daqsvc.rotor.synchronous.nonsynchronous import NonsynchronousLine

    Complexes = NDArray[np.complex128]
    Floats = NDArray[np.float64]

__all__ = ["DEPARTURE", "KeyphasorProbe", "Probe", "RotorBankDetector", "RotorMode"]

_MIN_PROBE_SPREAD = 0.5
"""Least |sin| of the angle between the probes: 30 degrees apart they still see both axes."""
_RETUNE = 0.003
"""Relative change of speed that the reference orbits follow; smaller ones are jitter of the edges."""
_SAME_SPEED = 0.02
"""Relative difference from the speed of the calibration up to which its motion is the healthy one."""
_FEW_REVOLUTIONS = 32
"""Whose steady motion shows whether a machine that the observers take for healthy has changed."""
_HUNTING_REVOLUTIONS = 256
"""Over which the speed is seen to hunt."""
_PREDICTED_REVOLUTIONS = 100.0
"""Over which a steady motion is predicted: a change is there for as long, or longer."""
_BLIND_REVOLUTIONS = 3.0
"""Time for which the angle is trusted without an edge."""


@dataclass(slots=True)
class _Change:
    """What is known of a change of the machine.

    Attributes:
        departed: whether it has been stated that the machine has left the declared mode.
        left_index: first sample of it; None while the machine is healthy.
        off: how the modes miss its steady motion; None while none was compared.
        besides: what else than the modes explains it; None where nothing does.
    """

    departed: bool = False
    left_index: int | None = None
    off: Misfit | None = None
    besides: Explanation | None = None

    @property
    def no_mode_explains_it(self) -> bool:
        """Whether something else than the modes explains it, and no mode does."""
        return self.besides is not None and self.besides.is_no_mode


class RotorBankDetector:
    """Diagnoses a rotor by the bank of the paper; see `Detector`.

    Reports one `Diagnosis` a revolution, and one at once for every change of the declared mode. The
    probabilities in it are those of the rule that decides: under ``cusum`` the posterior odds of the
    evidence ``lead_M``. Under ``paper``, and while nothing is declared yet, the paper's conditional
    probabilities, which are always there as statistics ``paper.M`` too. The
    evidence, in nats: ``lead.M``, of the declared mode over mode M, and ``cusum.M``, of M against the
    declared one since the onset of its evidence. Under the paper's rule every severity is normal: a
    posterior of 0.9 is no ground for an alarm.

    The evidence against the declared mode may be past its threshold before it favours one other mode. The
    decision is then ``departure`` with the candidates as group, at once and until the cause is known.
    The declared mode has not changed by that.

    A rotor with two modes is only nearly the machine. There the steady motion after a change decides which
    faults it may be. The signatures of the calibrated rotor judge it (`daqsvc.rotor.steady_faults`). They do
    not where no healthy motion was measured at this speed, a mode has several faults in one, the probes are
    AC-coupled, or a revolution has fewer than 16 samples. Then, and where no fault explains the change, it is
    compared with where each mode takes the machine (`daqsvc.rotor.misfit`). What is too far from it is left
    out; what is not told apart by more than the model's own error is one group.

    The signatures also know faults that the bank has no mode of, and changes that no fault explains. These
    are in the group then by their own names, as ``stiffness_loss`` or ``unmodelled``. Where they explain the
    change much better than any mode, they are the decision. The nearest mode would be a wrong name.

    While the machine is not healthy, lines beside the shaft's harmonics are looked for. One that is none of
    the rotor's, as the mains, is taken out of the positions for as long as it is there. The observers then
    judge what is left, `reason` states the line, and ``line.*`` its figures (`daqsvc.rotor.line_removal`).

    A gap of up to a revolution is predicted through; after a longer one, and after one whose length is a
    guess, the observers start again. While the quality is not good there is no evidence, and the decision is
    held.

    Args:
        machine: name of the machine.
        stream: name of the stream with all three sensors.
        rate_hz: sampling rate.
        speed_rpm: expected speed; negative if the shaft turns clockwise. The keyphasor refines it.
        probes: two proximity probes.
        keyphasor: the keyphasor.
        rotor: the rotor; its exponent and friction are those of the rub observer.
        modes: the modes, healthiest first.
        noise_um: standard deviation of the sensor noise, the same in every mode.
        process_noise: power spectral density q of the linear observers, normalised; see
            `usual_process_noise` if not given.
        rub_process_noise: that of the rub observers; large, so that they follow what they do not know.
        rules: decision rule and thresholds.
        calibrate_revolutions: healthy revolutions at the start over which unbalance and static position are
            measured, used in every mode in place of the stated ones; 0 to trust what is stated.
        ac_coupled: whether the probes show no static position.
        name: name of the detector.

    Raises:
        ValueError: the figures cannot make a bank, or the probes look in nearly the same direction.
    """

    def __init__(
        self,
        *,
        machine: str,
        stream: str,
        rate_hz: float,
        speed_rpm: float,
        probes: tuple[Probe, Probe],
        keyphasor: KeyphasorProbe,
        rotor: RotorParameters,
        modes: Sequence[RotorMode],
        noise_um: float,
        process_noise: float | None = None,
        rub_process_noise: float = 0.1,
        rules: DecisionRules | None = None,
        calibrate_revolutions: int = 0,
        ac_coupled: bool = False,
        name: str = "rotor-bank",
    ) -> None:
        if not (math.isfinite(speed_rpm) and speed_rpm != 0.0 and math.isfinite(rate_hz) and rate_hz > 0.0):
            raise ValueError(
                f"rotor bank of {machine!r}: a speed of {speed_rpm} rpm sampled at {rate_hz} Hz cannot be "
                "followed; both must be finite, the rate above 0 and the speed not 0"
            )
        self.name = name
        self.stream = stream
        self._probes = probes
        self._keyphasor = keyphasor
        self._modes = tuple(modes)
        self._rules = rules or DecisionRules()
        self._direction = math.copysign(1.0, speed_rpm)
        self._duration = rotor.natural_frequency_rad_s / rate_hz
        self._nominal_period = 60.0 * rate_hz / abs(speed_rpm)
        self._rate_hz = rate_hz
        self.block = max(1, round(self._nominal_period / 4.0))

        spread = math.sin(math.radians(probes[1].angle_deg - probes[0].angle_deg))
        if abs(spread) < _MIN_PROBE_SPREAD:
            raise ValueError(
                f"rotor bank of {machine!r}: {probes[0].name!r} at {probes[0].angle_deg} and "
                f"{probes[1].name!r} at {probes[1].angle_deg} degrees look in nearly the same direction; "
                "the orbit needs two probes 30 to 150 degrees apart"
            )
        angles = np.radians([probe.angle_deg for probe in probes])
        self._units = np.array([probes[0].um_per_unit, probes[1].um_per_unit, 1.0])
        self._to_xy = np.linalg.inv(np.vstack((np.cos(angles), np.sin(angles)))) / rotor.clearance_um
        self._bank_modes = bank_modes(
            self._modes,
            rotor,
            speed_rpm,
            process_noise=process_noise,
            rub_process_noise=rub_process_noise,
            ac_coupled=ac_coupled,
        )
        self._clearance_um = rotor.clearance_um
        self._judge = RevolutionJudge(probes, missing=OBSERVED_SHARE, pooled=1)
        self._exact = set() if rotor.on_film else {"static_load"}
        self._faults = {mode.name: fault_of(mode, rotor) for mode in self._modes}
        others = named_besides(self._modes, rotor, ac_coupled=ac_coupled)
        self._stater = BankDiagnosisBuilder(
            machine=machine,
            detector=name,
            stream=stream,
            sensors=(probes[0].name, probes[1].name, keyphasor.name),
            modes=self._modes,
            faults=tuple(self._faults.values()),
            others=others,
            rules=self._rules,
        )
        # Probes that are not at right angles share the noise unevenly; this is the mean of both axes.
        self._noise = noise_um / rotor.clearance_um / abs(spread)
        self._bank = self._new_bank()
        self._tracker = KeyphasorTracker(
            threshold=keyphasor.threshold_v,
            hysteresis=keyphasor.hysteresis_v,
            period_samples=self._nominal_period,
            edge=keyphasor.edge,
        )
        healthy = abs(self._bank_modes[0].rotor.orbit()) * rotor.clearance_um
        self._least_motion_um = DEAD * math.hypot(noise_um, healthy / math.sqrt(2.0))
        self._watch = OrbitWatch(
            noise=self._noise,
            rest=self._bank_modes[0].rotor.rest,
            probes=(probes[0].name, probes[1].name),
            keyphasor=keyphasor.name,
            backward=_backward_share(self._bank_modes[0].rotor),
        )
        if calibrate_revolutions < 0:
            raise ValueError(
                f"rotor bank of {machine!r}: calibrate_revolutions is {calibrate_revolutions}; "
                "write 0 to trust the stated rotor, or 20 or more"
            )
        self._lines = LineRemoval(
            rate_hz, rotor.clearance_um, clockwise=speed_rpm < 0.0, ac_coupled=ac_coupled
        )
        self._calibrate_revolutions = calibrate_revolutions
        self._calibration = SteadyFit() if calibrate_revolutions else None
        self._calibrated_speed = math.nan
        self._steady_motions = SteadyMotions(self._duration)
        self._two_mode_rotor = rotor if others else None
        self._steady_faults: SteadyFaults | None = None
        self._change = _Change()
        self._speeds: deque[float] = deque(maxlen=_HUNTING_REVOLUTIONS)
        self._harmonics: Complexes = np.zeros(4, dtype=np.complex128)
        self._last_revolution = np.empty((0, 3))
        self._next_index: int | None = None
        self._revolutions = 0.0
        self._progress_index: int | None = None
        self._decision = UNDETERMINED_DECISION

    @property
    def faults(self) -> Mapping[str, str]:
        """What each mode is in the words of a verdict, by name: ``"normal"``, ``"unbalance"``, ..."""
        return self._faults

    @property
    def knows_other_faults(self) -> bool:
        """Whether it also knows faults that it has no mode of, and changes that no fault explains."""
        return self._steady_faults is not None

    @property
    def lines(self) -> tuple[NonsynchronousLine, ...]:
        """Lines beside the shaft's harmonics that are left out of the positions, the largest first."""
        return self._lines.lines

    @property
    def bank_modes(self) -> tuple[BankMode, ...]:
        """The models behind the modes, healthy first, as they are now."""
        return self._bank_modes

    @property
    def noise(self) -> float:
        """Standard deviation of the measured position, in clearances."""
        return self._noise

    @property
    def duration(self) -> float:
        """Normalised time between samples."""
        return self._duration

    @property
    def natural_frequency_hz(self) -> float:
        """Of the healthy rotor, the unit of speeds: that of the run-up where there is one."""
        return self._duration * self._rate_hz / math.tau

    @property
    def rules(self) -> DecisionRules:
        """Thresholds and the rule that declares."""
        return self._rules

    @property
    def variance_factor(self) -> float:
        """Room for what the models miss: of the noise, and of the orbit where two modes represent many."""
        healthy = self._bank_modes[0].rotor
        if healthy.isotropic:
            return VARIANCE_FACTOR
        missed = MODEL_ERROR * math.hypot(abs(healthy.orbit()), abs(healthy.backward_orbit()))
        return VARIANCE_FACTOR + 0.5 * (missed / self._noise) ** 2

    @property
    def clearance_um(self) -> float:
        """Radial clearance, the unit of lengths."""
        return self._clearance_um

    def warm(self) -> None:
        """Compile the kernels on a bank that is thrown away."""
        n = self.block
        bank = self._new_bank()
        bank.process(np.zeros((n, 2)), np.ones(n), np.zeros(n))
        bank.retune(bank.speed, 0.0)
        if len(bank.couplings):
            SteadyMotions(self._duration).of(bank.observers, bank.couplings)

    def process(self, window: Window) -> Sequence[Diagnosis]:
        """See `Detector.process`."""
        return [diagnosis for part in window.parts() for diagnosis in self._process(part)]

    def _process(self, window: Window) -> list[Diagnosis]:
        """Take in a window without a break behind its first sample."""
        samples = np.asarray(window.samples, dtype=np.float64)[:, self._columns]
        samples = np.where(np.isfinite(samples), samples, np.nan) * self._units
        first_index = window.first_index
        gap = 0 if self._next_index is None else first_index - self._next_index
        if window.breaks:
            # At which angle the shaft is by now, only the next pulses show; its speed is what it was.
            self._begin_anew(keep_speed=True)
            self._lines.forget()
        elif 0 < gap <= self._nominal_period:
            samples = np.concatenate((np.full((gap, 3), np.nan), samples))
            first_index -= gap
        elif gap:
            self._begin_anew()
            if gap < 0:  # the stream has begun again
                self._lines.forget()
        self._next_index = end_index = first_index + len(samples)
        diagnoses: list[Diagnosis] = []
        for begin in range(0, len(samples), self.block):
            part = samples[begin : begin + self.block]
            last_index = first_index + begin + len(part) - 1
            t_ns = window.t_end_ns - round((end_index - 1 - last_index) * window.period_ns)
            diagnoses += self._step(part, last_index + 1 - len(part), t_ns, window.period_ns)
        return diagnoses

    def _begin_anew(self, *, keep_speed: bool = False) -> None:
        self._tracker.reset(keep_speed=keep_speed)
        self._bank.reseed()
        self._watch.reset()
        self._last_revolution = np.empty((0, 3))

    def silent(self, silence_s: float, t_ns: int) -> Sequence[Diagnosis]:
        """See `Detector.silent`."""
        index = self._next_index or 0
        severity = self._stater.severity(self._bank.decision, self._change.besides)
        return [self._stater.silence(silence_s, self._decision, severity, index, t_ns, self._revolutions)]

    @property
    def _columns(self) -> list[int]:
        return [self._probes[0].column, self._probes[1].column, self._keyphasor.column]

    def _new_bank(self, *, variance_factor: float = 1.0, decision: int = UNDETERMINED) -> ModelBank:
        return ModelBank(
            self._bank_modes,
            noise=self._noise,
            duration=self._duration,
            rules=self._rules,
            variance_factor=variance_factor,
            decision=decision,
        )

    def _step(self, samples: Floats, first_index: int, t_ns: int, period_ns: float) -> list[Diagnosis]:
        """A block of probe, probe and keyphasor samples; ``t_ns`` is the time of its last one."""
        end_index = first_index + len(samples)
        track = self._tracker.process(samples[:, 2])
        revolution = round(self._tracker.period_samples)
        self._last_revolution = np.concatenate((self._last_revolution, samples))[-revolution:]
        angle = self._direction * track.angle_rad
        cos, sin = np.cos(angle), np.sin(angle)
        xy = samples[:, :2] @ self._to_xy
        if stands_still(samples[:, :2]):
            xy[:] = np.nan
        xy = self._lines.without(first_index, track.angle_rad, xy, revolution)
        self._watch.add(xy, cos, sin, revolution)
        verdict = self._verdict()
        self._follow_speed(float(angle[0]))
        unsure = self._bank.decision == UNDETERMINED and not self._watch.confirmed
        if verdict.quality != "good":
            self._watch.spoil()
        if verdict.quality != "good" or unsure:
            xy[:] = np.nan

        before = self._revolutions
        self._revolutions = before + len(samples) / self._tracker.period_samples
        if self._progress_index is None:
            self._progress_index = first_index
        if self._calibration is not None:
            diagnosis = self._calibrate(xy, cos, sin, verdict, end_index, t_ns)
            report = self._bank.process(xy * np.nan, cos, sin)  # only time passes
        else:
            report = self._bank.process(xy, cos, sin)
            diagnosis = self._changes(report, verdict, first_index, len(samples), before, t_ns, period_ns)
            diagnosis += self._departures(report, verdict, end_index, t_ns, period_ns)
        if math.floor(self._revolutions) > math.floor(before):
            self._speeds.append(self._bank.speed)
            self._compare_steady(report)
            self._look_for_lines(report)
            began, self._progress_index = self._progress_index, end_index
            changed = self._take_besides()
            if changed:
                began = self._onset(end_index)
            diagnosis.append(
                self._diagnosis(report, verdict, began, end_index, t_ns, self._bank.decision, changed=changed)
            )
        return diagnosis

    def _changes(
        self,
        report: BankReport,
        verdict: RevolutionQuality,
        first_index: int,
        n: int,
        before: float,
        t_ns: int,
        period_ns: float,
    ) -> list[Diagnosis]:
        """One statement for every change of the declared mode."""
        changes = []
        after = self._revolutions
        for change in report.declarations:
            onset = first_index + min(change.onset, change.sample)
            if change.mode == 0:
                self._change.besides, self._change.left_index = None, None
            elif self._change.left_index is None:
                self._change.left_index = onset
            if self._change.no_mode_explains_it:
                continue
            self._decision = self._modes[change.mode].name
            self._revolutions = before + (change.sample + 1) / self._tracker.period_samples
            at_ns = t_ns - round((n - 1 - change.sample) * period_ns)
            end = first_index + change.sample + 1
            changes.append(self._diagnosis(report, verdict, onset, end, at_ns, change.mode, changed=True))
        self._revolutions = after
        return changes

    def _departures(
        self, report: BankReport, verdict: RevolutionQuality, end_index: int, t_ns: int, period_ns: float
    ) -> list[Diagnosis]:
        """The statement that the machine has left the declared mode, once."""
        departure, departed = report.departure, self._change.departed
        self._change.departed = departure is not None
        if departure is None and report.decision == 0:
            self._change.left_index = None
        if departure is None or departed:
            return []
        at_ns = t_ns + round(departure.sample * period_ns)
        end = end_index + departure.sample
        onset = min(end_index - 1 + departure.onset, end - 1)
        if self._change.left_index is None:
            self._change.left_index = onset
        if self._change.no_mode_explains_it:
            return []
        return [self._diagnosis(report, verdict, onset, end, at_ns, report.decision, changed=False)]

    def _onset(self, end_index: int) -> int:
        """Since when the machine is not healthy: by the observers, or by what was judged."""
        known, besides = self._change.left_index, self._change.besides
        if known is None:
            known = self._change.left_index = end_index - (1 if besides is None else besides.samples)
        return min(known, end_index - 1)

    def _take_besides(self) -> bool:
        """Take in what else than the modes explains the change; whether another decision or group is stated.

        Where no mode explains it, that is the decision: which mode is nearest means nothing.
        """
        found = None if self._steady_faults is None else self._steady_faults.found
        mode = self._bank.decision
        seen = found is not None and bool(found.others) and (mode != 0 or found.is_no_mode)
        before, now = self._change.besides, found if seen else None
        self._change.besides = now
        stated = self._decision
        if now is not None and now.is_no_mode:
            self._decision = now.others[0]
        elif stated not in self._faults and mode != UNDETERMINED:
            self._decision = self._modes[mode].name
        others = [set() if one is None else set(one.others) for one in (before, now)]
        return self._decision != stated or others[0] != others[1]

    def _look_for_lines(self, report: BankReport) -> None:
        """Take other lines out from now on: what the observers saw is of another motion then."""
        bank = self._bank
        if self._rules.rule != "cusum" or bank.decision == UNDETERMINED or self._calibration is not None:
            return
        if not self._lines.look(self._healthy_orbit, healthy=bank.decision == 0 and report.departure is None):
            return
        bank.reseed()
        self._watch.spoil()
        self._compare_nothing()

    def _compare_nothing(self) -> None:
        """No steady change leaves any mode out."""
        count = len(self._modes)
        self._change.off = None
        self._bank.exclude(np.zeros(count, dtype=np.bool_), np.zeros((count, count), dtype=np.bool_))
        if self._steady_faults is not None:
            self._steady_faults.forget()

    def _healthy_orbit(self) -> HealthyOrbit:
        """The healthy motion at this speed, seen from where the shaft turns counter-clockwise."""
        rotor, w = self._bank_modes[0].rotor, self._bank.speed
        parts = (rotor.rest, rotor.orbit(w), rotor.backward_orbit(w), *self._harmonics[:2])
        baseline: Complexes = self._clearance_um * np.array(parts, dtype=np.complex128)
        noise = 2.0 * (self._noise * self._clearance_um) ** 2
        return HealthyOrbit(baseline.conj() if self._direction < 0.0 else baseline, noise, self._clearance_um)

    def _compare_steady(self, report: BankReport) -> None:
        """Leave out the modes that the steady motion is too far from, also the healthy one."""
        bank, count = self._bank, len(self._modes)
        if not len(bank.couplings) or self._rules.rule != "cusum" or bank.decision == UNDETERMINED:
            return
        nearby = hunting(self._bank_modes[0].rotor, bank.speed)
        healthy = np.concatenate((nearby[len(nearby) // 2], self._harmonics))
        motions, changed = self._watch.sound_motions, bank.decision != 0 or report.departure is not None
        change = steady_change(motions if changed else motions[-_FEW_REVOLUTIONS:], healthy, self._noise)
        swings = swing(self._bank_modes[0].rotor, min(self._speeds), max(self._speeds))
        certain = (
            change is not None
            and self._at_calibrated_speed
            and (
                change.is_certain(nearby, self._noise, swings)
                or change.is_load(self._least_load, self._noise)
            )
        )
        if not (changed or certain):
            self._compare_nothing()
            return
        if change is None:
            return
        healthy_like = bank.look_alike(0)
        if healthy_like[bank.decision] and change.is_over(healthy, self._least_load):
            # The observers would never go back to healthy from a mode that looks like it.
            healthy_like[0] = False
            self._change.off = None
            bank.exclude(healthy_like, np.zeros((count, count), dtype=np.bool_))
            return
        off = self._compared(change, self._steady_motions.of(bank.observers, bank.couplings))
        if self._steady_faults is not None and self._at_calibrated_speed:
            self._steady_faults.look(change)
            off = self._steady_faults.narrowed(off)
        off.excluded[0] |= certain
        bank.exclude(off.excluded, off.pairs)
        self._change.off = off

    def _compared(self, change: SteadyChange, motions: Complexes) -> Misfit:
        """A steady change beside where each mode takes the machine."""
        return misfit(
            change,
            motions,
            list(self._faults.values()),
            noise=self._noise,
            nats=self._rules.group_nats,
            exact=self._exact,
        )

    def predicted_groups(self) -> dict[str, tuple[str, ...]]:
        """What would be stated of a machine that did exactly what a mode does, by the name of the mode.

        Returns:
            Of each faulty mode its fault, with all that would not be told from it; ``"normal"`` is among
            them if the change would not be seen. Empty for a rotor with one mode, which leaves the decision
            to the evidence of its observers. A rub is left out that is not steady, or does not touch.
        """
        bank = self._bank
        if not len(bank.couplings) or self._rules.rule != "cusum":
            return {}
        motions = self._steady_motions.of(bank.observers, bank.couplings)
        nearby = hunting(self._bank_modes[0].rotor, bank.speed)
        faults = np.array(list(self._faults.values()))
        samples = round(_PREDICTED_REVOLUTIONS * self._nominal_period)
        variance = np.full(motions.shape[1], 2.0 * self._noise**2 / samples)
        steady_faults = self._steady_faults or self._judge_steady(motions[0], variance)
        predicted = {}
        for k in range(1, len(faults)):
            change = SteadyChange(motions[k] - motions[0], samples, variance)
            if not np.isfinite(change.moved).all():
                continue
            off = self._compared(change, motions)
            likely = None if steady_faults is None else steady_faults.predicted(change)
            if likely is not None:
                off = narrowed(off, faults, likely)
            others = [] if likely is None else sorted(likely.difference(faults.tolist()))
            # No steady motion is compared of a machine that all observers take for the healthy one.
            least = math.inf if steady_faults is None else steady_faults.least_load
            off.excluded[0] = change.is_certain(nearby, self._noise) or change.is_load(least, self._noise)
            together = off.pairs[k] | (bank.look_alike(k) & ~off.excluded)
            names = [faults[k], *faults[together], *others]
            predicted[self._modes[k].name] = tuple(dict.fromkeys(map(str, names)))
        return predicted

    @property
    def _least_load(self) -> float:
        """How far the mildest load moves the shaft, from wherever it comes; infinite if it is not judged."""
        return math.inf if self._steady_faults is None else self._steady_faults.least_load

    @property
    def _at_calibrated_speed(self) -> bool:
        """Whether the healthy motion needs no model to be known."""
        return abs(self._bank.speed / self._calibrated_speed - 1.0) < _SAME_SPEED

    def _calibrate(
        self, xy: Floats, cos: Floats, sin: Floats, verdict: RevolutionQuality, end_index: int, t_ns: int
    ) -> list[Diagnosis]:
        """Measure the healthy motion; at the end, put it into every mode and report it."""
        assert self._calibration is not None  # noqa: S101 - the caller asks while there is one
        self._calibration.add(xy, cos, sin, 1.0 / self._tracker.period_samples)
        if self._calibration.samples < self._calibrate_revolutions * self._tracker.period_samples:
            return []
        motion = self._calibration.solve()
        # A speed that hunts is another at every moment; the motion is that of the mean.
        speed = self._direction * math.tau * self._calibration.turns_per_sample / self._duration
        self._bank_modes, self._calibrated_speed = adapted(self._bank_modes, motion, speed), speed
        self._bank = self._new_bank(variance_factor=self.variance_factor, decision=0)
        self._steady_motions = SteadyMotions(self._duration)
        measured = steady_baseline(self._watch.sound_motions[-self._calibrate_revolutions :], self._noise)
        if measured is not None:
            baseline, variance = measured
            self._steady_faults, self._harmonics = self._judge_steady(baseline, variance), baseline[3:]
        self._calibration = None
        self._decision = self._modes[0].name
        report = self._bank.process(np.empty((0, 2)), np.empty(0), np.empty(0))
        onset = end_index - motion.samples
        return [self._diagnosis(report, verdict, onset, end_index, t_ns, 0, changed=True)]

    def _judge_steady(self, baseline: Complexes, variance: Floats) -> SteadyFaults | None:
        """A judge of steady changes from a healthy motion, in clearances; None where it is not of use."""
        bank, rotor = self._bank, self._two_mode_rotor
        if rotor is None or not len(bank.couplings):
            return None
        return SteadyFaults(
            rotor,
            list(self._faults.values()),
            self._steady_motions.of(bank.observers, bank.couplings),
            baseline=baseline,
            variance=variance,
            speed_rad_s=bank.speed * rotor.natural_frequency_rad_s,
        )

    def _follow_speed(self, angle_rad: float) -> None:
        if math.isnan(angle_rad):
            return
        speed = self._direction * 2.0 * math.pi / self._tracker.period_samples / self._duration
        if abs(speed / self._bank.speed - 1.0) > _RETUNE:
            self._bank.retune(speed, angle_rad)

    def _verdict(self) -> RevolutionQuality:
        """What the last revolution is worth."""
        revolution = self._last_revolution
        whole = len(revolution) >= round(self._tracker.period_samples)
        if not (whole and is_sound(revolution, self._least_motion_um)):
            bad = self._look_closely(revolution, whole=whole)
            if bad.quality != "good":
                return bad
        if (blind := self._tracker.revolutions_since_edge) > _BLIND_REVOLUTIONS:
            expected_rpm = 60.0 * self._rate_hz / self._nominal_period
            return RevolutionQuality(
                "missing",
                f"{self._keyphasor.name}: no pulse for {blind:.0f} revolutions at {expected_rpm:.0f} rpm; "
                "check that the shaft turns at that speed, and that the pulse crosses "
                f"{self._keyphasor.threshold_v} V",
            )
        if doubt := self._watch.doubt():
            return RevolutionQuality("not_ok", doubt)
        return RevolutionQuality()

    def _look_closely(self, revolution: Floats, *, whole: bool) -> RevolutionQuality:
        """What a revolution is worth, or the part of one that there is at the beginning."""
        probes = revolution[:, :2]
        if whole:
            bad = self._judge.judge(probes, self._least_motion_um)
        else:
            bad = self._judge.missing(probes) or RevolutionQuality()
        if bad.quality == "good" and (wrong := beyond_any_unit(revolution[:, 2])):
            return RevolutionQuality("not_ok", f"{self._keyphasor.name} {wrong}; {RESCALE}")
        return bad

    def _diagnosis(
        self,
        report: BankReport,
        verdict: RevolutionQuality,
        first_index: int,
        end_index: int,
        t_ns: int,
        decision: int,
        *,
        changed: bool,
    ) -> Diagnosis:
        speed_rpm = 60.0 * self._rate_hz / self._tracker.period_samples
        moment = Moment(first_index, end_index, t_ns, self._revolutions, speed_rpm)
        return self._stater.state(
            report,
            verdict,
            moment,
            decision=decision,
            stated=self._decision,
            changed=changed,
            off=self._change.off,
            besides=self._change.besides,
            lines=self._lines.lines,
            missing_share=float(np.isnan(self._last_revolution[:, :2]).any(axis=1).mean()),
        )


def _backward_share(healthy: NormalisedRotor) -> float:
    """Backward over forward radius of the healthy orbit, the most of it at the speeds about its own."""
    forward, backward = np.abs(hunting(healthy, healthy.w)[:, :2]).T
    seen = forward > 0.0
    return float(np.max(backward[seen] / forward[seen], initial=0.0))
