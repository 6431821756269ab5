"""The rotor bank as a detector: two proximity probes and a keyphasor in, the rotor's mode out."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from daqsvc.diagnosis.record import DataQuality, Diagnosis, Severity, silence_reason
from daqsvc.dsp.keyphasor import Edge, KeyphasorTracker
from daqsvc.rotor.bank import UNDETERMINED, BankReport, ModelBank
from daqsvc.rotor.decision import DecisionRules
from daqsvc.rotor.discretise import BankMode

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from daqsvc.diagnosis.detector import Window
    from daqsvc.rotor.model import RotorParameters

    Floats = NDArray[np.float64]

MODEL = "laval-rotor-rub/1"

_MIN_PROBE_SPREAD = 0.5
"""Least |sin| of the angle between the probes: 30 degrees apart they still see both axes."""
_RETUNE = 0.003
"""Relative change of speed that the reference orbits follow; smaller ones are jitter of the edges."""
_BLIND_REVOLUTIONS = 3.0
"""So long the angle is trusted without an edge."""
_DEAD = 0.05
"""A probe that moves less than this part of what it must is dead."""
_CLIPPED = 1 / 16
"""Part of a revolution at one extreme value that makes a probe clipped."""


@dataclass(frozen=True, slots=True)
class Probe:
    """A proximity probe.

    Attributes:
        name: name of the sensor.
        column: its column in the stream, micrometres from the shaft-centred position.
        angle_deg: where it points, from +x against the clock.
    """

    name: str
    column: int
    angle_deg: float


@dataclass(frozen=True, slots=True)
class KeyphasorProbe:
    """A keyphasor.

    Attributes:
        name: name of the sensor.
        column: its column in the stream, volts.
        threshold_v: level that marks the edge.
        hysteresis_v: how far the voltage must return before there can be another edge.
        edge: the edge that marks angle zero.
    """

    name: str
    column: int
    threshold_v: float
    hysteresis_v: float = 0.5
    edge: Edge = "rising"


@dataclass(frozen=True, slots=True)
class RotorMode:
    """A mode of the rotor.

    Attributes:
        name: name of the mode.
        damping_ratio: zeta in this mode.
        severity: how bad it is.
        rub: whether the shaft touches its housing.
    """

    name: str
    damping_ratio: float
    severity: Severity = "normal"
    rub: bool = False


@dataclass(frozen=True, slots=True)
class _Verdict:
    """Whether the last revolution can be trusted, and why not."""

    quality: DataQuality = "good"
    reason: str = ""


class RotorBankDetector:
    """Diagnoses a rotor by the bank of the paper; see `Detector`.

    Says one `Diagnosis` a revolution, and one at once for every change of the declared mode. The
    probabilities in it are those of the rule that decides: under ``cusum`` the posterior odds of the
    evidence ``lead_M``; under ``paper``, and while nothing is declared yet, the paper's conditional
    probabilities, which are always there as statistics ``paper.M`` too. The
    evidence, in nats: ``lead.M``, of the declared mode over mode M, and ``cusum.M``, of M against the
    declared one since the onset of its evidence. Under the paper's rule every severity is normal: a
    posterior of 0.9 is no ground for an alarm.

    A gap of up to a revolution is predicted through; after a longer one the observers start anew. While
    the quality is not good there is no evidence, and the decision is held.

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
        process_noise: power spectral density q of the linear observers, normalised.
        rub_process_noise: that of the rub observers; large, so that they follow what they do not know.
        rules: decision rule and thresholds.
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
        process_noise: float = 1e-4,
        rub_process_noise: float = 0.1,
        rules: DecisionRules | None = None,
        name: str = "rotor-bank",
    ) -> None:
        if not (math.isfinite(speed_rpm) and speed_rpm != 0.0 and math.isfinite(rate_hz) and rate_hz > 0.0):
            raise ValueError(
                f"rotor bank of {machine!r}: a speed of {speed_rpm} rpm sampled at {rate_hz} Hz cannot be "
                "followed; both must be finite, the rate above 0 and the speed not 0"
            )
        self.name = name
        self.stream = stream
        self._machine = machine
        self._probes = probes
        self._keyphasor = keyphasor
        self._modes = tuple(modes)
        self._rules = rules or DecisionRules()
        self._direction = math.copysign(1.0, speed_rpm)
        self._duration = rotor.natural_frequency_rad_s / rate_hz
        self._nominal_period = 60.0 * rate_hz / abs(speed_rpm)
        self._sensors = (probes[0].name, probes[1].name, keyphasor.name)
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
        self._to_xy = np.linalg.inv(np.vstack((np.cos(angles), np.sin(angles)))) / rotor.clearance_um
        self._bank_modes = tuple(
            BankMode(
                mode.name,
                rotor.normalised(speed_rpm, mode.damping_ratio),
                rub_process_noise if mode.rub else process_noise,
                mode.rub,
            )
            for mode in self._modes
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
        self._least_motion_um = _DEAD * math.hypot(noise_um, healthy / math.sqrt(2.0))
        self._last_revolution = np.empty((0, 3))
        self._next_index: int | None = None
        self._revolutions = 0.0
        self._progress_index: int | None = None
        self._decision = "undetermined"

    def warm(self) -> None:
        """Compile the kernels on a bank that is thrown away."""
        n = self.block
        bank = self._new_bank()
        bank.process(np.zeros((n, 2)), np.ones(n), np.zeros(n))
        bank.retune(bank.speed, 0.0)

    def process(self, window: Window) -> Sequence[Diagnosis]:
        """See `Detector.process`."""
        samples = np.asarray(window.samples, dtype=np.float64)[:, self._columns]
        samples = np.where(np.isfinite(samples), samples, np.nan)
        first_index = window.first_index
        gap = 0 if self._next_index is None else first_index - self._next_index
        if 0 < gap <= self._nominal_period:
            samples = np.concatenate((np.full((gap, 3), np.nan), samples))
            first_index -= gap
        elif gap:
            self._tracker.reset()
            self._bank.reseed()
            self._last_revolution = np.empty((0, 3))
        self._next_index = end_index = first_index + len(samples)
        said: list[Diagnosis] = []
        for begin in range(0, len(samples), self.block):
            part = samples[begin : begin + self.block]
            last_index = first_index + begin + len(part) - 1
            t_ns = window.t_end_ns - round((end_index - 1 - last_index) * window.period_ns)
            said += self._step(part, last_index + 1 - len(part), t_ns, window.period_ns)
        return said

    def silent(self, silence_s: float, t_ns: int) -> Sequence[Diagnosis]:
        """See `Detector.silent`."""
        names = [mode.name for mode in self._modes]
        index = self._next_index or 0
        known = self._decision in names and self._rules.rule == "cusum"
        return [
            Diagnosis(
                machine=self._machine,
                detector=self.name,
                t_ns=t_ns,
                stream=self.stream,
                first_index=index,
                end_index=index,
                decision=self._decision,
                severity=self._modes[names.index(self._decision)].severity if known else "normal",
                revolutions=self._revolutions,
                quality="missing",
                reason=silence_reason(self.stream, silence_s),
                sensors=self._sensors,
                model=MODEL,
            )
        ]

    @property
    def _columns(self) -> list[int]:
        return [self._probes[0].column, self._probes[1].column, self._keyphasor.column]

    def _new_bank(self) -> ModelBank:
        return ModelBank(self._bank_modes, noise=self._noise, duration=self._duration, rules=self._rules)

    def _step(self, samples: Floats, first_index: int, t_ns: int, period_ns: float) -> list[Diagnosis]:
        """A block of probe, probe and keyphasor samples; ``t_ns`` is the time of its last one."""
        end_index = first_index + len(samples)
        track = self._tracker.process(samples[:, 2])
        revolution = round(self._tracker.period_samples)
        self._last_revolution = np.concatenate((self._last_revolution, samples))[-revolution:]
        verdict = self._judge()
        angle = self._direction * track.angle_rad
        self._follow_speed(float(angle[0]))

        xy = samples[:, :2] @ self._to_xy
        if verdict.quality != "good" or _stands_still(samples[:, :2]):
            xy[:] = np.nan
        report = self._bank.process(xy, np.cos(angle), np.sin(angle))

        said = []
        before = self._revolutions
        for change in report.declarations:
            self._decision = self._modes[change.mode].name
            self._revolutions = before + (change.sample + 1) / self._tracker.period_samples
            at_ns = t_ns - round((len(samples) - 1 - change.sample) * period_ns)
            onset = first_index + min(change.onset, change.sample)
            end = first_index + change.sample + 1
            said.append(self._diagnosis(report, verdict, onset, end, at_ns, change.mode, changed=True))
        self._revolutions = before + len(samples) / self._tracker.period_samples
        if self._progress_index is None:
            self._progress_index = first_index
        if math.floor(self._revolutions) > math.floor(before):
            began, self._progress_index = self._progress_index, end_index
            said.append(
                self._diagnosis(report, verdict, began, end_index, t_ns, report.decision, changed=False)
            )
        return said

    def _follow_speed(self, angle_rad: float) -> None:
        if math.isnan(angle_rad):
            return
        speed = self._direction * 2.0 * math.pi / self._tracker.period_samples / self._duration
        if abs(speed / self._bank.speed - 1.0) > _RETUNE:
            self._bank.retune(speed, angle_rad)

    def _judge(self) -> _Verdict:
        """What the last revolution is worth."""
        n = len(self._last_revolution)
        for column, probe in enumerate(self._probes):
            signal = self._last_revolution[:, column]
            signal = signal[~np.isnan(signal)]
            if n - len(signal) > n / 2:
                return _Verdict(
                    "missing",
                    f"{probe.name}: {n - len(signal)} of the last {n} samples are missing; "
                    "check the bus and the device",
                )
            if n < round(self._tracker.period_samples):
                continue
            if (deviation := float(signal.std())) < self._least_motion_um:
                return _Verdict(
                    "not_ok",
                    f"{probe.name}: moved by {deviation:.3g} um rms in the last revolution, at least "
                    f"{self._least_motion_um:.3g} um is expected; check the probe, its cable and driver",
                )
            if (clipped := _at_an_extreme(signal)) is not None:
                return _Verdict(
                    "not_ok",
                    f"{probe.name}: clipped at {clipped:.6g} um in the last revolution; "
                    "check the gap and the range of the converter",
                )
        if (blind := self._tracker.revolutions_since_edge) > _BLIND_REVOLUTIONS:
            expected_rpm = 60.0 * self._rate_hz / self._nominal_period
            return _Verdict(
                "missing",
                f"{self._keyphasor.name}: no pulse for {blind:.0f} revolutions at {expected_rpm:.0f} rpm; "
                "check that the shaft turns at that speed, and that the pulse crosses "
                f"{self._keyphasor.threshold_v} V",
            )
        return _Verdict()

    def _diagnosis(
        self,
        report: BankReport,
        verdict: _Verdict,
        first_index: int,
        end_index: int,
        t_ns: int,
        decision: int,
        *,
        changed: bool,
    ) -> Diagnosis:
        names = [mode.name for mode in self._modes]
        known = decision != UNDETERMINED
        evidence = {}
        probabilities = conditional = report.probabilities
        if known and self._rules.rule == "cusum":
            others = [i for i in range(len(names)) if i != report.decision]
            evidence = {f"lead.{names[i]}": float(report.lead_nats[i]) for i in others}
            evidence |= {f"cusum.{names[i]}": float(report.cusum_nats[i]) for i in others}
            odds = np.exp(-report.lead_nats)  # the decision leads itself by infinity in the report
            odds[report.decision] = 1.0
            probabilities = odds / odds.sum()
        statistics = {"speed": 60.0 * self._rate_hz / self._tracker.period_samples}
        statistics |= {f"paper.{name}": float(p) for name, p in zip(names, conditional, strict=True)}
        return Diagnosis(
            machine=self._machine,
            detector=self.name,
            t_ns=t_ns,
            stream=self.stream,
            first_index=first_index,
            end_index=end_index,
            decision=self._decision,
            changed=changed,
            severity=self._modes[decision].severity if known and self._rules.rule == "cusum" else "normal",
            probabilities=dict(zip(names, probabilities.tolist(), strict=True)),
            group=tuple(names[i] for i in report.group),
            statistics=statistics,
            units={"speed": "rpm"},
            thresholds={
                "cusum": self._rules.threshold_nats,
                "cusum.back": self._rules.back_threshold_nats,
                "probability": self._rules.probability_threshold,
            },
            evidence=evidence,
            revolutions=self._revolutions,
            quality=verdict.quality,
            reason=verdict.reason,
            sensors=self._sensors,
            model=MODEL,
        )


def _stands_still(probes: Floats) -> bool:
    """Whether a probe repeats one value through a block, as none does that sees a turning shaft."""
    return len(probes) > 2 and bool((probes == probes[0]).all(axis=0).any())


def _at_an_extreme(signal: Floats) -> float | None:
    """The extreme value that a signal is clipped at, or None.

    A coarse converter repeats its values between the extremes as well, and a sine only twice as often at
    its top as elsewhere: a clipped signal repeats its extreme four times as often as any other value.
    """
    values, counts = np.unique(signal, return_counts=True)
    usual = int(counts[1:-1].max(initial=0))
    least = max(_CLIPPED * len(signal), 4.0 * usual, 3.0)
    for extreme in (0, -1):
        if counts[extreme] >= least:
            return float(values[extreme])
    return None
