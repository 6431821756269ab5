"""Rolling bearings as a detector: accelerometers on their housings in, the damaged part out.

The healthy state is learnt from the first seconds in which nothing is found.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from daqsvc.bearing.baseline import learn_baseline
from daqsvc.bearing.identify import ChangeRules, NotIdentifiableError, compare_residual
from daqsvc.bearing.race.judge import WINDOW_S, RaceWatch
from daqsvc.bearing.race.verdict import RaceRules
from daqsvc.detectors.bearing.direction import Direction, RaceDirection
from daqsvc.detectors.bearing.evaluation import (
    LARGE,
    Evaluation,
    evidence_of,
    figures_of,
    thresholds_of,
    units_of,
)
from daqsvc.detectors.bearing.finding import SOUND, ConfirmedState, PersistenceFilter, find
from daqsvc.diagnosis.record import Diagnosis, silence_reason
from daqsvc.dsp.quality import UnfitError
from daqsvc.dsp.quality.clipped import refuse_clipped
from daqsvc.dsp.quality.missing import lacking
from daqsvc.dsp.quality.unit import refuse_beyond_any_unit
from daqsvc.dsp.speed.steadiness import SpeedError, measure_speed

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from numpy.typing import NDArray

    from daqsvc.bearing.baseline import BearingBaseline
    from daqsvc.bearing.identify import ResidualChange
    from daqsvc.bearing.race.verdict import RaceVerdict
    from daqsvc.detectors.bearing.finding import BearingFinding
    from daqsvc.detectors.bearing.housed import HousedBearing
    from daqsvc.diagnosis.detector import Window
    from daqsvc.diagnosis.record import Severity
    from daqsvc.dsp.quality import Quality
    from daqsvc.dsp.speed.keyphasor import KeyphasorProbe

    Floats = NDArray[np.float64]


class HealthyGathering:
    """Collects evaluations of a machine in good order until its healthy state can be learnt from them.

    Args:
        bearings: the bearings.
        rate_hz: sampling rate.
        calibrate_s: how much is needed.
    """

    def __init__(self, bearings: Sequence[HousedBearing], rate_hz: float, calibrate_s: float) -> None:
        self._bearings = bearings
        self._rate_hz = rate_hz
        self._needed = round(calibrate_s * rate_hz)
        self._gathered: list[NDArray[np.float32]] = []
        self._refused = ""

    @property
    def reason(self) -> str:
        """Why there is no healthy machine yet, for a person."""
        if self._refused:
            return f'no healthy state to tell "changed" by: {self._refused}'
        gathered = sum(map(len, self._gathered)) / self._rate_hz
        return f"learning the healthy state: {gathered:.0f} of {self._needed / self._rate_hz:.0f} s"

    def add(
        self, samples: NDArray[np.float32], finding: BearingFinding, speed_rpm: float
    ) -> BearingBaseline | None:
        """Take in an evaluation that follows those before.

        Args:
            samples: float32 ``[n, channels]`` of the stream.
            finding: what it has shown; one that shows a fault is not taken, and those before are forgotten.
            speed_rpm: speed of the shaft.

        Returns:
            The healthy machine, when there is enough of it.
        """
        if finding.verdict != "normal":
            self._gathered = []
            self._refused = f"the machine shows {finding.verdict.replace('_', ' ')} at {finding.where}"
            return None
        self._gathered.append(samples)
        if sum(map(len, self._gathered)) < self._needed:
            return None
        together = np.concatenate(self._gathered).astype(np.float64)
        self._gathered = []
        together[~np.isfinite(together)] = np.nan
        try:
            learnt = learn_baseline(
                {
                    name: together[:, column]
                    for bearing in self._bearings
                    for name, column in zip(bearing.sensors, bearing.columns, strict=True)
                },
                self._rate_hz,
                speed_rpm,
                {bearing.sensor: bearing.orders for bearing in self._bearings},
                [bearing.sensors for bearing in self._bearings],
                pairs={b.sensors: b.two.model for b in self._bearings if b.two is not None},
                units={name: unit for b in self._bearings for name, unit in b.units.items()},
                source="the running service",
            )
        except NotIdentifiableError as error:
            self._refused = str(error)
            return None
        self._refused = ""
        return learnt

    def forget(self) -> None:
        """Evaluations before this do not belong to those after it."""
        self._gathered = []


MODEL = "bearing-race/1"

_BLOCKS_PER_LOOK = 5
_LEAST_LAST = 0.5
"""Part of an evaluation that is worth a last one."""
_NO_LONGER_LARGE = 8.0
"""Danger stays until the innovations are less than so many times the healthy ones."""
SAME_SPEED = 0.05
"""A shaft that turns faster or slower by more than this share is not compared with the healthy one."""


class BearingDetector:
    """States whether a rolling bearing is damaged, and which part of it; see `Detector`.

    Every 2.5 s the last ten seconds are evaluated (`RaceWatch`), each bearing by the accelerometer on its
    housing; the bearing that shows most decides. What the healthy machine's own vibration cannot predict
    states whether anything has changed. The first seconds, or a baseline of an earlier time, are the healthy
    machine; seconds that show a fault or are not steady are not taken for it, and the reason is stated.

    Decisions are ``undetermined``, ``normal``, ``changed``, ``inner``, ``outer``, ``ball`` and
    ``inner_or_outer``. Two evaluations must agree before a fault is raised, eight before it is withdrawn. Any
    fault is alert; danger from ten times the healthy innovations on.

    An evaluation with missing samples, a dead or clipped accelerometer, or a machine at rest clears
    nothing. The decision is held and the reason stated, unless another bearing shows a fault.

    A bearing with two accelerometers is also watched by direction (`RaceDirection`); `find` states how that
    joins what the lines show. With a keyphasor the lines are looked for at the measured speed. Where that
    leaves the tolerance of the race test, the evidence begins again; at another speed than the healthy
    machine's nothing is compared with it. Neither clears anything.

    Args:
        machine: name of the machine.
        stream: name of the stream with all sensors.
        rate_hz: sampling rate.
        speed_rpm: shaft speed, right to about 1 %; of a shaft with a keyphasor, what it turns at mostly.
        bearings: the bearings.
        keyphasor: what measures the speed, if anything does.
        rules: what counts as a change.
        race: settings of the race test.
        baseline: the healthy machine; made of the first ``calibrate_s`` seconds if not given.
        calibrate_s: how much of it is needed.
        name: name of the detector.
        keep: called with the baseline that was made of the first seconds, on the detector's thread.
    """

    def __init__(
        self,
        *,
        machine: str,
        stream: str,
        rate_hz: float,
        speed_rpm: float,
        bearings: Sequence[HousedBearing],
        keyphasor: KeyphasorProbe | None = None,
        rules: ChangeRules | None = None,
        race: RaceRules | None = None,
        baseline: BearingBaseline | None = None,
        calibrate_s: float = 30.0,
        name: str = "bearing",
        keep: Callable[[BearingBaseline], None] | None = None,
    ) -> None:
        self.name = name
        self.stream = stream
        self.block = round(WINDOW_S / _BLOCKS_PER_LOOK * rate_hz)
        self.bearings = tuple(bearings)
        self.baseline = baseline
        self._machine = machine
        self._rate_hz = rate_hz
        self._speed_rpm = abs(speed_rpm)
        self.rules = rules or ChangeRules()
        self._race = race or RaceRules()
        self.keyphasor = keyphasor
        self._learning = HealthyGathering(self.bearings, rate_hz, calibrate_s)
        self._keep = keep
        self._watches, self._directions = self._new_watches(), self._new_directions()
        self._pending: list[NDArray[np.float32]] = []
        self._persistence = PersistenceFilter()
        self.seen: Evaluation | None = None
        """The last evaluation of good samples."""
        self._large = False
        self._end_index = 0
        self._speed_unknown = self._has_looked = False

    @property
    def standing(self) -> ConfirmedState:
        """The confirmed state."""
        return self._persistence.standing

    def warm(self) -> None:
        """See `Detector.warm`: makes the tables of the transforms, compiles the test of direction."""
        samples = round(WINDOW_S * self._rate_hz)
        noise = np.random.default_rng(1).standard_normal((samples, 2))
        RaceWatch(self._rate_hz, self._speed_rpm, self.bearings[0].orders, self._race).evaluate(noise[:, 0])
        for direction in self._directions.values():
            direction.judge(noise)

    def process(self, window: Window) -> Sequence[Diagnosis]:
        """See `Detector.process`."""
        if window.snapshot:
            return [self._snapshot(window)]
        if window.first_index != self._end_index:
            self._forget()
        diagnoses = []
        count = len(window.samples) // self.block
        for number in range(count):
            self._pending.append(window.samples[number * self.block : (number + 1) * self.block])
            self._end_index = window.first_index + (number + 1) * self.block
            if len(self._pending) == _BLOCKS_PER_LOOK:
                after = len(window.samples) - (number + 1) * self.block
                diagnoses.append(self._look(window.t_end_ns - round(after * window.period_ns)))
        return diagnoses

    def silent(self, silence_s: float, t_ns: int) -> Sequence[Diagnosis]:
        """See `Detector.silent`."""
        evaluated = Evaluation({}, {}, "missing", silence_reason(self.stream, silence_s), None)
        return [self._statement(evaluated, self._end_index, t_ns, changed=False)]

    def finish(self, rest: NDArray[np.float32], t_ns: int) -> Diagnosis | None:
        """A last evaluation, at the end of a recording.

        Args:
            rest: float32 ``[n, channels]``, what did not fill a block.
            t_ns: time of its last sample.

        Returns:
            None if there is too little that has not been examined.
        """
        if len(rest):
            self._pending.append(rest)
            self._end_index += len(rest)
        left = sum(map(len, self._pending))
        if left == 0 or (self.seen is not None and left < _LEAST_LAST * _BLOCKS_PER_LOOK * self.block):
            return None
        return self._look(t_ns, last=True)

    def _snapshot(self, window: Window) -> Diagnosis:
        """Evaluate a block by itself: evidence is not summed over several, but they must agree as usual."""
        self._end_index = window.first_index + len(window.samples)
        for watch in self._watches.values():
            watch.forget()
        least = _LEAST_LAST * WINDOW_S
        if len(window.samples) < least * self._rate_hz:
            length_s = len(window.samples) / self._rate_hz
            reason = (
                f"a block of {self.stream} is {length_s:.3g} s long, and a bearing is judged by {least:g} s "
                "or more; make the device take longer blocks"
            )
            evaluated = Evaluation({}, {}, "missing", reason, None)
            return self._statement(evaluated, window.first_index, window.t_end_ns, changed=False)
        # What follows is another block: a row without samples keeps them apart.
        apart = np.full((1, window.samples.shape[1]), np.nan, np.float32)
        self._pending = [window.samples]
        return self._look(window.t_end_ns, apart=apart)

    def _look(self, t_ns: int, *, last: bool = False, apart: NDArray[np.float32] | None = None) -> Diagnosis:
        """Judge what is pending; ``apart`` keeps it from what follows where that does not go on from it."""
        samples = np.concatenate(self._pending)
        self._pending = []
        first_index = self._end_index - len(samples)
        evaluated = self._judge(samples.astype(np.float64))
        share = self._missing_share(samples)
        if evaluated.quality != "good":
            self._persistence.interrupt()
            return self._statement(evaluated, first_index, t_ns, changed=False, missing_share=share)
        assert evaluated.finding is not None  # noqa: S101 - good
        self.seen = evaluated
        changed = self._persistence.update(evaluated.finding, last=last)
        if self.baseline is None:
            learnt_from = samples if apart is None else np.concatenate((samples, apart))
            self.baseline = self._learning.add(learnt_from, evaluated.finding, self._speed_rpm)
            if self.baseline is not None:
                self._watches, self._directions = self._new_watches(), self._new_directions()
                if self._keep is not None:
                    self._keep(self.baseline)
        return self._statement(evaluated, first_index, t_ns, changed=changed, missing_share=share)

    def _missing_share(self, samples: NDArray[np.float32]) -> float:
        """Share of the samples that lack a value of any sensor that the evaluation rests on."""
        columns = [column for bearing in self.bearings for column in bearing.columns]
        if self.keyphasor is not None:
            columns.append(self.keyphasor.column)
        return float((~np.isfinite(samples[:, columns])).any(axis=1).mean())

    def _judge(self, samples: Floats) -> Evaluation:
        """What the bearings show, one by one and together."""
        samples = np.where(np.isfinite(samples), samples, np.nan)
        unfit = list(self._follow_speed(samples))
        races: dict[str, RaceVerdict] = {}
        changes: dict[str, ResidualChange] = {}
        directions: dict[str, Direction] = {}
        for bearing in () if self._speed_unknown else self.bearings:
            signal = samples[:, bearing.column]
            if lost := lacking(bearing.sensor, signal):
                self._watches[bearing.name].forget()
                unfit.append(("missing", lost))
                continue
            try:
                for name, column in zip(bearing.sensors, bearing.columns, strict=True):
                    refuse_beyond_any_unit(samples[:, column], name)
                refuse_clipped(signal)
                race = self._watches[bearing.name].evaluate(signal)
                departed = self._departed(bearing, samples)
            except (UnfitError, _StandsStillError) as error:
                self._watches[bearing.name].forget()
                unfit.append(("not_ok", f"{bearing.sensor}: {error}"))
                continue
            unfit += _lacking_pair(bearing, samples)
            races[bearing.name] = race
            # "Normal" of samples that had to be put right clears nothing; a fault seen through them is one.
            unfit += [("not_ok", f"{bearing.sensor}: {repair}") for repair in race.repairs]
            if departed is not None:
                changes[bearing.name] = departed
            suspected = race.verdict not in SOUND or (departed is not None and departed.changed)
            directions |= self._directed(bearing, samples, suspected=suspected)
        change = max(changes.values(), key=lambda one: one.departure, default=None)
        finding = find(races, change, self.rules.false_alarm_probability, directions) if races else None
        reason = "; ".join(why for _, why in unfit)
        if unfit and (finding is None or finding.verdict in SOUND):
            # What one bearing does not show is no evidence about another that cannot be seen.
            return Evaluation(races, changes, unfit[0][0], reason, finding, directions)
        return Evaluation(races, changes, "good", reason, finding, directions)

    def _follow_speed(self, samples: Floats) -> Iterator[tuple[Quality, str]]:
        """Measure the speed; begin again where it has changed. Yields what is against the evaluation."""
        self._speed_unknown = False
        if self.keyphasor is None:
            return
        volts = samples[:, self.keyphasor.column]
        try:
            refuse_beyond_any_unit(volts, self.keyphasor.name)
            speed = measure_speed(volts, self.keyphasor, self._rate_hz)
        except (SpeedError, UnfitError) as error:
            self._speed_unknown = True
            self._begin_anew()
            lost = lacking(self.keyphasor.name, volts, ", and pulses with them")
            yield ("missing", lost) if lost else ("not_ok", str(error))
            return
        before, tolerance = self._speed_rpm, self._race.speed_tolerance
        if speed.drift > tolerance:
            self._speed_unknown = True
            self._begin_anew()
            drifts = f"the speed changes by {speed.drift:.1%} within {len(samples) / self._rate_hz:.2g} s"
            yield (
                "not_ok",
                f"{drifts}: the bearings are judged again when it is steady within {tolerance:.1%}",
            )
            return
        if abs(speed.rpm / before - 1.0) > tolerance:
            self._speed_rpm = speed.rpm
            self._begin_anew()
            if self._has_looked:
                yield (
                    "not_ok",
                    f"the speed has gone from {before:.0f} to {speed.rpm:.0f} rpm: the evidence begins again",
                )
        self._has_looked = True
        if self.baseline is not None and not self._comparable:
            healthy = f"the healthy state is that at {self.baseline.speed_rpm:.0f} rpm"
            yield "not_ok", f"the speed is {speed.rpm:.0f} rpm, and {healthy}: only damage with lines shows"

    @property
    def _comparable(self) -> bool:
        """Whether the shaft turns as fast as the healthy one did."""
        return (
            self.baseline is not None and abs(self._speed_rpm / self.baseline.speed_rpm - 1.0) <= SAME_SPEED
        )

    def _directed(self, bearing: HousedBearing, samples: Floats, *, suspected: bool) -> dict[str, Direction]:
        """What the two accelerometers of a bearing show; empty if it has one only."""
        if bearing.name not in self._directions or not self._comparable:
            return {}
        pair = samples[:, list(bearing.columns)]
        judged = self._directions[bearing.name].judge(pair, suspected=suspected)
        return {} if judged is None else {bearing.name: judged}

    def _departed(self, bearing: HousedBearing, samples: Floats) -> ResidualChange | None:
        """How the innovations at a bearing differ from the healthy machine's.

        Raises:
            _StandsStillError: the machine does not run, or the sensor is loose.
        """
        if self.baseline is None or not self._comparable:
            return None
        if bearing.sensors not in self.baseline.residuals:
            return None
        healthy = self.baseline.residuals[bearing.sensors]
        levels = healthy.levels_db(samples[:, list(bearing.columns)])
        if not np.isfinite(levels).any():
            return None
        change = compare_residual(healthy, levels, self.rules)
        if change.quiet:
            raise _StandsStillError(
                f"{-change.rise_db[0]:.1f} dB quieter than the healthy machine; it stands still, or the "
                "sensor is loose"
            )
        return change

    def _new_watches(self) -> dict[str, RaceWatch]:
        """Race tests of the bearings at this speed, with the healthy machine where it is known at that."""
        races = self.baseline.races if self.baseline is not None and self._comparable else {}
        return {
            bearing.name: RaceWatch(
                self._rate_hz, self._speed_rpm, bearing.orders, self._race, races.get(bearing.sensor)
            )
            for bearing in self.bearings
        }

    def _new_directions(self) -> dict[str, RaceDirection]:
        """Of the bearings with two accelerometers, when the healthy machine is known."""
        pairs = {} if self.baseline is None else self.baseline.pairs
        return {
            bearing.name: RaceDirection(bearing.two, pairs[bearing.sensors], self.rules)
            for bearing in self.bearings
            if bearing.two is not None and bearing.sensors in pairs
        }

    def _begin_anew(self) -> None:
        """The speed has changed."""
        self._learning.forget()
        self._persistence.interrupt()
        self._watches = self._new_watches()

    def _forget(self) -> None:
        """Samples are missing: evidence from before and after does not belong together."""
        self._pending = []
        self._learning.forget()
        self._persistence.interrupt()
        for watch in self._watches.values():
            watch.forget()

    def _severity(self, change: ResidualChange | None) -> Severity:
        if self._persistence.standing.sound:
            self._large = False
            return "normal"
        if change is not None:
            self._large = change.ratio > (_NO_LONGER_LARGE if self._large else LARGE)
        return "danger" if self._large else "alert"

    def _statement(
        self,
        evaluated: Evaluation,
        first_index: int,
        t_ns: int,
        *,
        changed: bool,
        missing_share: float | None = None,
    ) -> Diagnosis:
        standing = self._persistence.standing
        where = standing.where or (evaluated.finding.where if evaluated.finding is not None else "")
        good = evaluated.quality == "good"
        figures = figures_of(evaluated, where)
        diagnosis = Diagnosis(
            machine=self._machine,
            detector=self.name,
            t_ns=t_ns,
            stream=self.stream,
            first_index=first_index,
            end_index=self._end_index,
            decision=standing.decision,
            changed=changed,
            severity=self._severity(evaluated.change),
            # Without a verdict the decision is the one from before, which these would contradict.
            probabilities={str(k): p for k, p in evaluated.finding.probabilities.items()}
            if good and evaluated.finding
            else {},
            group=standing.group,
            statistics=figures,
            units=units_of(figures),
            thresholds=thresholds_of(evaluated, where),
            evidence=evidence_of(evaluated, where),
            quality=evaluated.quality,
            reason=evaluated.reason,
            sensors=tuple(bearing.sensor for bearing in self.bearings if bearing.name == standing.where)
            or tuple(bearing.sensor for bearing in self.bearings),
            model=MODEL,
            where=standing.where,
            missing_share=missing_share,
        )
        if good and not evaluated.reason and self.baseline is None:
            return replace(diagnosis, reason=self._learning.reason)
        return diagnosis


def _lacking_pair(bearing: HousedBearing, samples: Floats) -> Iterator[tuple[Quality, str]]:
    """What is against "normal" where the second accelerometer lacks samples: then no change can be seen."""
    for name, column in zip(bearing.sensors, bearing.columns, strict=True):
        if column != bearing.column and (lost := lacking(name, samples[:, column])):
            yield "missing", lost


class _StandsStillError(ValueError):
    """The machine does not run."""
