"""Rolling bearings as a detector: accelerometers on their housings in, the damaged part out."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from daqsvc.bearing.identify import NotIdentifiableError
from daqsvc.bearing.identify_baseline import learn_baseline
from daqsvc.bearing.identify_change import ChangeRules, compare_residual
from daqsvc.bearing.race.rules import RaceRules
from daqsvc.bearing.race.verdict import RaceInputError
from daqsvc.bearing.race.watch import WINDOW_S, RaceWatch
from daqsvc.diagnosis.bearing_direction import Direction, RaceDirection, TwoSensors
from daqsvc.diagnosis.bearing_finding import SOUND, BearingFinding, find
from daqsvc.diagnosis.bearing_look import (
    LARGE,
    Look,
    evidence_of,
    figures_of,
    thresholds_of,
    units_of,
)
from daqsvc.diagnosis.bearing_quality import ClippedError, refuse_clipped
from daqsvc.diagnosis.bearing_standing import Standing, Steadfast
from daqsvc.diagnosis.record import Diagnosis, silence_reason

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray

    from daqsvc.bearing.geometry import BearingOrders
    from daqsvc.bearing.identify_baseline import BearingBaseline
    from daqsvc.bearing.identify_change import ResidualChange
    from daqsvc.bearing.race.verdict import RaceVerdict
    from daqsvc.diagnosis.detector import Window
    from daqsvc.diagnosis.record import DataQuality, Severity

    Floats = NDArray[np.float64]

MODEL = "bearing-race/1"

_BLOCKS_PER_LOOK = 5
_LEAST_LAST = 0.5
"""Part of a look that is worth a last one."""
_MISSING = 0.01
"""Part of a look's samples that may be missing; single ones are bridged."""
_NO_LONGER_LARGE = 8.0
"""Danger stays until the innovations are less than so many times the healthy ones."""


@dataclass(frozen=True, slots=True)
class HousedBearing:
    """A bearing with the accelerometer on its housing.

    Attributes:
        name: of the bearing.
        sensor: name of the accelerometer.
        column: its column in the stream.
        orders: fault orders.
        two: the accelerometer on the rotor and the bearing's masses, if its races are also told by direction.
    """

    name: str
    sensor: str
    column: int
    orders: BearingOrders
    two: TwoSensors | None = None

    @property
    def sensors(self) -> tuple[str, ...]:
        """The accelerometers that it is judged by."""
        return (self.sensor,) if self.two is None else (self.two.rotor, self.sensor)

    @property
    def columns(self) -> tuple[int, ...]:
        """Their columns."""
        return (self.column,) if self.two is None else (self.two.column, self.column)


class BearingDetector:
    """Says whether a rolling bearing is damaged, and which part of it; see `Detector`.

    Every 2.5 s the last ten seconds are looked at (`RaceWatch`), each bearing by the accelerometer on its
    housing; the bearing that shows most decides. What the healthy machine's own vibration cannot predict
    says whether anything has changed. The first seconds, or a baseline of an earlier time, are the healthy
    machine; seconds that show a fault or are not steady are not taken for it, and the reason is said.

    Decisions are ``undetermined``, ``normal``, ``changed``, ``inner``, ``outer``, ``ball`` and
    ``inner_or_outer``. Two looks must agree before a fault is raised, eight before it is taken back. Any
    fault is alert; danger from ten times the healthy innovations on.

    A look with missing samples, or at a dead or clipped accelerometer, or at a machine that stands still,
    clears nothing: the decision is held and the reason said, unless another bearing shows a fault by itself.

    Args:
        machine: name of the machine.
        stream: name of the stream with all sensors.
        rate_hz: sampling rate.
        speed_rpm: shaft speed, right to about 1 %.
        bearings: the bearings.
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
        self._calibrate_samples = round(calibrate_s * rate_hz)
        self._keep = keep
        self._watches = self._new_watches()
        self._pending: list[NDArray[np.float32]] = []
        self._healthy: list[NDArray[np.float32]] = []
        self._refused = ""
        self._directions = {
            bearing.name: RaceDirection(bearing.two, rate_hz)
            for bearing in self.bearings
            if bearing.two is not None
        }
        self._steadfast = Steadfast()
        self.seen: Look | None = None
        """The last look at good samples."""
        self._large = False
        self._end_index = 0

    @property
    def standing(self) -> Standing:
        """What it stands by."""
        return self._steadfast.standing

    def warm(self) -> None:
        """See `Detector.warm`: makes the tables of the transforms, compiles what tells races by direction."""
        noise = np.random.default_rng(1).standard_normal(self._watches[self.bearings[0].name].window)
        RaceWatch(self._rate_hz, self._speed_rpm, self.bearings[0].orders, self._race).take(noise)
        for direction in self._directions.values():
            direction.judge(noise.reshape(-1, 2))

    def process(self, window: Window) -> Sequence[Diagnosis]:
        """See `Detector.process`."""
        if window.first_index != self._end_index:
            self._forget()
        said = []
        count = len(window.samples) // self.block
        for number in range(count):
            self._pending.append(window.samples[number * self.block : (number + 1) * self.block])
            self._end_index = window.first_index + (number + 1) * self.block
            if len(self._pending) == _BLOCKS_PER_LOOK:
                after = len(window.samples) - (number + 1) * self.block
                said.append(self._look(window.t_end_ns - round(after * window.period_ns)))
        return said

    def silent(self, silence_s: float, t_ns: int) -> Sequence[Diagnosis]:
        """See `Detector.silent`."""
        look = Look({}, {}, "missing", silence_reason(self.stream, silence_s), None)
        return [self._statement(look, self._end_index, t_ns, changed=False)]

    def finish(self, rest: NDArray[np.float32], t_ns: int) -> Diagnosis | None:
        """A last look, at the end of a recording.

        Args:
            rest: float32 ``[n, channels]``, what did not fill a block.
            t_ns: time of its last sample.

        Returns:
            None if there is too little that has not been looked at.
        """
        if len(rest):
            self._pending.append(rest)
            self._end_index += len(rest)
        left = sum(map(len, self._pending))
        if left == 0 or (self.seen is not None and left < _LEAST_LAST * _BLOCKS_PER_LOOK * self.block):
            return None
        return self._look(t_ns, last=True)

    def _look(self, t_ns: int, *, last: bool = False) -> Diagnosis:
        """Judge what is pending."""
        samples = np.concatenate(self._pending)
        self._pending = []
        first_index = self._end_index - len(samples)
        look = self._judge(samples.astype(np.float64))
        if look.quality != "good":
            self._steadfast.interrupt()
            return self._statement(look, first_index, t_ns, changed=False)
        assert look.finding is not None  # noqa: S101 - good
        self.seen = look
        changed = self._steadfast.look(look.finding, last=last)
        if self.baseline is None:
            self._calibrate(samples, look.finding)
        elif look.finding.verdict == "normal":
            self._rehearse(samples)
        return self._statement(look, first_index, t_ns, changed=changed)

    def _judge(self, samples: Floats) -> Look:
        """What the bearings show, one by one and together."""
        samples = np.where(np.isfinite(samples), samples, np.nan)
        races: dict[str, RaceVerdict] = {}
        unfit: list[tuple[DataQuality, str]] = []
        changes: dict[str, ResidualChange] = {}
        directions: dict[str, Direction] = {}
        for bearing in self.bearings:
            signal = samples[:, bearing.column]
            missing = int(np.isnan(signal).sum())
            if missing > _MISSING * len(signal):
                self._watches[bearing.name].forget()
                lost = f"{missing} of {len(signal)} samples are missing"
                unfit.append(("missing", f"{bearing.sensor}: {lost}; check the bus and the device"))
                continue
            try:
                refuse_clipped(signal)
                race = self._watches[bearing.name].take(signal)
                departed = self._departed(bearing, samples)
            except (ClippedError, RaceInputError, _StandsStillError) as error:
                self._watches[bearing.name].forget()
                unfit.append(("not_ok", f"{bearing.sensor}: {error}"))
                continue
            races[bearing.name] = race
            if departed is not None:
                changes[bearing.name] = departed
            if race.verdict not in SOUND or (departed is not None and departed.changed):
                directions |= self._directed(bearing, samples)
        change = max(changes.values(), key=lambda one: one.departure, default=None)
        finding = find(races, change, self.rules.false_alarm_probability, directions) if races else None
        if unfit and (finding is None or finding.verdict in SOUND):
            # What one bearing does not show says nothing about another that cannot be seen.
            return Look(races, changes, unfit[0][0], "; ".join(why for _, why in unfit), finding)
        reason = "; ".join(why for _, why in unfit)
        return Look(races, changes, "good", reason, finding, directions)

    def _rehearse(self, samples: NDArray[np.float32]) -> None:
        """Learn directions from a look at the machine in good order, once."""
        for bearing in self.bearings:
            direction = self._directions.get(bearing.name)
            if direction is not None and not direction.ready:
                direction.learn(samples[:, list(bearing.columns)].astype(np.float64))

    def _directed(self, bearing: HousedBearing, samples: Floats) -> dict[str, Direction]:
        """Which race the two accelerometers of a bearing tell; empty if it has one only."""
        if bearing.name not in self._directions:
            return {}
        found = self._directions[bearing.name].judge(samples[:, list(bearing.columns)])
        return {} if found is None else {bearing.name: found}

    def _departed(self, bearing: HousedBearing, samples: Floats) -> ResidualChange | None:
        """How the innovations at a bearing differ from the healthy machine's.

        Raises:
            _StandsStillError: the machine does not run, or the sensor is loose.
        """
        if self.baseline is None or bearing.sensors not in self.baseline.residuals:
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

    def _calibrate(self, samples: NDArray[np.float32], finding: BearingFinding) -> None:
        """Gather the healthy machine, and learn it when there is enough of it."""
        if finding.verdict != "normal":
            self._healthy = []
            self._refused = f"the machine shows {finding.verdict.replace('_', ' ')} at {finding.where}"
            return
        self._healthy.append(samples)
        if sum(map(len, self._healthy)) < self._calibrate_samples:
            return
        gathered = np.concatenate(self._healthy).astype(np.float64)
        self._healthy = []
        gathered[~np.isfinite(gathered)] = np.nan
        try:
            self.baseline = learn_baseline(
                {
                    name: gathered[:, column]
                    for bearing in self.bearings
                    for name, column in zip(bearing.sensors, bearing.columns, strict=True)
                },
                self._rate_hz,
                self._speed_rpm,
                {bearing.sensor: bearing.orders for bearing in self.bearings},
                [bearing.sensors for bearing in self.bearings],
                source="the running service",
            )
        except NotIdentifiableError as error:
            self._refused = str(error)
            return
        self._refused = ""
        self._watches = self._new_watches()
        if self._keep is not None:
            self._keep(self.baseline)

    def _new_watches(self) -> dict[str, RaceWatch]:
        races = {} if self.baseline is None else self.baseline.races
        return {
            bearing.name: RaceWatch(
                self._rate_hz, self._speed_rpm, bearing.orders, self._race, races.get(bearing.sensor)
            )
            for bearing in self.bearings
        }

    def _forget(self) -> None:
        """Samples are missing: evidence from before and after does not belong together."""
        self._pending = []
        self._healthy = []
        self._steadfast.interrupt()
        for watch in self._watches.values():
            watch.forget()

    def _severity(self, change: ResidualChange | None) -> Severity:
        if self._steadfast.standing.sound:
            self._large = False
            return "normal"
        if change is not None:
            self._large = change.ratio > (_NO_LONGER_LARGE if self._large else LARGE)
        return "danger" if self._large else "alert"

    def _statement(self, look: Look, first_index: int, t_ns: int, *, changed: bool) -> Diagnosis:
        standing = self._steadfast.standing
        where = standing.where or (look.finding.where if look.finding is not None else "")
        good = look.quality == "good"
        figures = figures_of(look, where)
        said = Diagnosis(
            machine=self._machine,
            detector=self.name,
            t_ns=t_ns,
            stream=self.stream,
            first_index=first_index,
            end_index=self._end_index,
            decision=standing.decision,
            changed=changed,
            severity=self._severity(look.change),
            probabilities={str(k): p for k, p in look.finding.probabilities.items()} if look.finding else {},
            group=standing.group,
            statistics=figures,
            units=units_of(figures),
            thresholds=thresholds_of(look, where),
            evidence=evidence_of(look, where),
            quality=look.quality,
            reason=look.reason,
            sensors=tuple(bearing.sensor for bearing in self.bearings if bearing.name == standing.where)
            or tuple(bearing.sensor for bearing in self.bearings),
            model=MODEL,
        )
        if good and not look.reason and self.baseline is None:
            return replace(said, reason=self._calibrating())
        return said

    def _calibrating(self) -> str:
        if self._refused:
            return f'no healthy state to tell "changed" by: {self._refused}'
        gathered = sum(map(len, self._healthy)) / self._rate_hz
        needed = self._calibrate_samples / self._rate_hz
        return f"learning the healthy state: {gathered:.0f} of {needed:.0f} s"


class _StandsStillError(ValueError):
    """The machine does not run."""
