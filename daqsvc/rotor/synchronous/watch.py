"""A calibrated rotor under watch: departure at once, identity after settling, the healthy state again.

The machine's life is a chain of segments, each a stretch in which it does not change. A departure test runs
on the segment. When it states that the machine has changed, a new segment begins at the estimated onset, and
the segment's mean is identified against the healthy baseline at growing intervals (`LOOKS`). Names within the
first revolutions are those of the transient.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Literal, TypeAlias

import numpy as np

from daqsvc.rotor.synchronous.baseline import (
    Calibration,
    NotCalibratableError,
    at_speed,
    calibrate,
    compensated,
    deviation_of,
    with_more,
)
from daqsvc.rotor.synchronous.departure import (
    DepartureEvidence,
    DepartureTest,
    Reference,
    Spread,
    nonstationarity,
    threshold_for,
)
from daqsvc.rotor.synchronous.judged import (
    JudgedRevolution,
    Thrice,
    lasting_energy,
    noise_scatter,
    scatter,
    thrice_of,
)
from daqsvc.rotor.synchronous.lessons import Lessons
from daqsvc.rotor.synchronous.nonsynchronous import EVERY, Found, HealthyOrbit, NonsynchronousSearch
from daqsvc.rotor.synchronous.signatures import Identification, NamingRules, WithoutLine, identify
from daqsvc.rotor.synchronous.speed_law import EARLIER_SPEEDS
from daqsvc.rotor.synchronous.transient import KNOWN_WITHIN, REVOLUTIONS, Comparison, LastOrbits
from daqsvc.rotor.synchronous.vectors import SynchronousVectors

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from daqsvc.dsp.speed.revolutions import Revolutions
    from daqsvc.rotor.laval import LavalRotor

    Complexes = NDArray[np.complex128]
    Floats = NDArray[np.float64]


State: TypeAlias = Literal["calibrating", "watching", "departed"]

LOOKS = (3, 5, 8, 12, 20, 30, 50, 80, 120, 220)
"""Revolutions since the onset after which a change is examined; then every 110 more."""
_NAMED_FROM = 8
"""Revolutions since the onset before which no evaluation gives a name: the rotor is still on its way."""
_TRUSTED_FROM = 12
"""Revolutions since the onset from which on two evaluations that see nothing end the alarm."""
_LATER_LOOKS = 110
_SETTLING = 8
"""Revolutions after an onset before the new segment's own reference begins."""
_LEAST_SEGMENT = 30
_SEGMENT_THRESHOLD_NATS = 30.0
"""A changed machine is less steady than a healthy one: only clear further changes begin a new segment."""
_KEPT = 512
"""Revolutions that identification can reach back."""
_PLACED_WITHIN = 0.5
"""Samples within which a keyphasor's edge lies while no others place it."""
_ENDED = 3
"""Revolutions that are judged first after a line has ended."""
_LEFT_OF_LINE = 0.05
"""Part of a line that may stay in a harmonic that it beats with: no grid is quite steady."""
_ABRUPT = 4
"""Revolutions in the window of a departure up to which its transient is examined."""


@dataclass(frozen=True, slots=True, kw_only=True)
class WatchRules:
    """How the watch decides.

    Attributes:
        calibrate_revolutions: revolutions of the healthy machine that make the baseline.
        false_alarms_per_1000_rev: wanted rate of false departures.
        energy_threshold_nats: threshold of the non-harmonic energy.
        naming: how a change gets its name.
        probe_drift_um: standard deviation of the mean position that is drift of the probes.
        speed_uncertainty: relative standard deviation of a stated speed that replaces a keyphasor.
        angle_assumed: whether the angle rests on a stated speed at all.
        retry: whether to try again after data that cannot be the baseline.
    """

    calibrate_revolutions: int = 50
    false_alarms_per_1000_rev: float = 0.1
    energy_threshold_nats: float = 12.0
    naming: NamingRules = field(default_factory=NamingRules)
    probe_drift_um: float = 0.0
    speed_uncertainty: float = 0.0
    angle_assumed: bool = True
    retry: bool = True


@dataclass(frozen=True, slots=True)
class WatchReport:
    """What the watch states after a revolution.

    Attributes:
        revolution: revolutions since the start, this one included.
        end_index: samples since the start up to its end.
        state: what the watch does.
        evidence: of the departure test; None while calibrating.
        departed: whether a departure was declared on this revolution.
        onset_revolution: first revolution of the present segment, None while the machine is healthy.
        identification: what the change is; None while the machine is healthy or before the first evaluation.
        looked: whether the identification is of this revolution.
        refused: why the last revolutions could not be the baseline; empty if they could.
    """

    revolution: int
    end_index: int
    state: State
    evidence: DepartureEvidence | None = None
    departed: bool = False
    onset_revolution: int | None = None
    identification: Identification | None = None
    looked: bool = False
    refused: str = ""


class RotorWatch:
    """Watches one rotor by its synchronous vectors.

    Args:
        rotor: what is known about it.
        rate_hz: sampling rate.
        calibration: of an earlier time; made of the first revolutions if not given.
        rules: thresholds.
    """

    def __init__(
        self,
        rotor: LavalRotor,
        rate_hz: float,
        *,
        calibration: Calibration | None = None,
        rules: WatchRules | None = None,
    ) -> None:
        self.rules = rules or WatchRules()
        self.rotor = rotor
        self.rate_hz = rate_hz
        self.calibration: Calibration | None = None
        self.refused = ""
        self.revolutions = 0
        self._waiting: list[SynchronousVectors] = []
        self._previous: Complexes = np.empty((0, 5), dtype=np.complex128)
        self._speeds: Floats = np.empty(0)
        self._rows: deque[JudgedRevolution] = deque(maxlen=_KEPT)
        self._lessons = Lessons(self.rules.calibrate_revolutions, calibration)
        self._segment: list[JudgedRevolution] = []
        self._test: DepartureTest | None = None
        self._healthy: Calibration | None = None
        self._reference: Reference | None = None
        self._begun, self._middle = 0, 0.0
        self._onset: int | None = None
        self._reference_from = 0
        self._look = 0
        self._identification: Identification | None = None
        self._orbits = LastOrbits(_ABRUPT)
        self._alarm: tuple[int, int] | None = None
        self._comparison: Comparison | None = None
        self._thrice: Thrice | None = None
        self._was_line: bool | None = None
        self._lines = NonsynchronousSearch(rate_hz, self.rules.speed_uncertainty)
        if calibration is not None:
            self._begin(calibration)

    @property
    def learnt(self) -> Calibration | None:
        """The healthy machine for another start; None while there is none (`Lessons.kept`)."""
        return None if self.calibration is None else self._lessons.kept(self.calibration)

    @property
    def state(self) -> State:
        """What the watch does now."""
        if self.calibration is None:
            return "calibrating"
        return "watching" if self._onset is None else "departed"

    def evaluate(
        self, vectors: SynchronousVectors, orbits: Revolutions | None = None, *, settled: bool = True
    ) -> list[WatchReport]:
        """Take in revolutions, in order; one report for each that could be fitted.

        Args:
            vectors: their synchronous vectors in um.
            orbits: their samples in um; without them the way from one orbit to the next cannot tell
                unbalance from loss of damping.
            settled: whether their angle is as exact as that of the baseline. If not, only a change that the
                angle cannot explain raises an alarm.
        """
        reports = []
        ends = [] if orbits is None else [*orbits.starts[1:].tolist(), len(orbits.xy)]
        for i in range(len(vectors)):
            one = vectors[i : i + 1]
            self.revolutions += 1
            if orbits is not None:
                part = slice(int(orbits.starts[i]), ends[i])
                z = orbits.xy[part, 0] + 1j * orbits.xy[part, 1]
                turns = orbits.angle_rad[part] / (2.0 * math.pi)
                self._orbits.add(self.revolutions, turns, z)
                self._lines.add(self.revolutions, orbits.first_index + part.start, turns, z)
            if one.usable[0]:
                reports.append(self._take(one, settled=settled))
            else:
                self._pass_over(one, settled=settled)
        return reports

    def _pass_over(self, one: SynchronousVectors, *, settled: bool) -> None:
        """Keep the speed of a revolution that nothing else is known of, for the rate of the next ones."""
        deviation = np.empty(0)
        if self.calibration is not None and settled:
            deviation = deviation_of(one, self.calibration.speed_rad_s, self.rate_hz)
        known = np.isfinite(deviation).all() and len(deviation)
        self._speeds = np.append(self._speeds, deviation)[-EARLIER_SPEEDS:] if known else np.empty(0)

    def _take(self, one: SynchronousVectors, *, settled: bool) -> WatchReport:
        if self.calibration is None:
            return self._calibrate(one)
        moved, terms = compensated(
            one, self.rotor, self.calibration.speed_rad_s, self.rate_hz, self.calibration.law, self._speeds
        )
        rate_known = len(self._speeds) == EARLIER_SPEEDS
        self._speeds = np.append(self._speeds, terms[:, 0])[-EARLIER_SPEEDS:]
        nonstationary = float(
            nonstationarity(moved, one.noise, one.samples, self.calibration.baseline, self._previous)[0]
        )
        self._previous = np.vstack((self._previous[-1:], moved))
        row = JudgedRevolution(
            self.revolutions,
            moved[0] - self.calibration.baseline,
            nonstationary,
            terms[0],
            one.thrice[0],
        )
        self._rows.append(row)
        assert self._test is not None  # noqa: S101 - made with the calibration
        evidence = None
        if self._onset is None and self.calibration.law is not None and not rate_known:
            pass  # By how much 1X is late is not known.
        elif self._onset is None and not settled:
            turned_um = _PLACED_WITHIN * 2.0 * math.pi / float(one.samples[0]) * self.calibration.amplitude_um
            evidence = self._test.look_at(row.vector, row.terms, turned_um)
        elif self._tests(row):
            evidence = self._add(row)
        departed = evidence is not None and evidence.departed
        looked = False
        if departed and evidence is not None:
            self._depart(row.revolution - evidence.window + 1, evidence.window)
            abrupt = self._follows_transients and evidence.window <= _ABRUPT
            self._alarm = (row.revolution, evidence.window) if abrupt else None
            self._comparison = None
        elif self._onset is not None:
            before = self._identification
            if self._alarm is not None and row.revolution == self._alarm[0] + REVOLUTIONS:
                self._comparison = self._orbits.compare(self._onset, self._healthy or self.calibration)
                if self._comparison is not None:
                    self._identify(row.revolution, may_name=True)
                    looked = True
            looked = self._maybe_look(row.revolution) or looked
            departed = self._changes_again(before, row.revolution)
        elif settled and rate_known:
            self._learn(row)
        return self._report(one, evidence, departed=departed, looked=looked)

    def _calibrate(self, one: SynchronousVectors) -> WatchReport:
        self._waiting.append(one)
        if len(self._waiting) >= self.rules.calibrate_revolutions and (self.rules.retry or not self.refused):
            vectors = SynchronousVectors.joined(self._waiting)
            try:
                made = calibrate(vectors, self.rotor, self.rate_hz, angle_assumed=self.rules.angle_assumed)
            except NotCalibratableError as error:
                self.refused = str(error)
                del self._waiting[: max(1, self.rules.calibrate_revolutions // 2)]
            else:
                self._learn_first(made, vectors[vectors.usable])
                self._begin(made)
        return self._report(one, None, departed=False, looked=False)

    def _learn_first(self, made: Calibration, vectors: SynchronousVectors) -> None:
        """Keep what a calibration was made of: later revolutions teach more together with it."""
        moved, terms = compensated(vectors, made.rotor, made.speed_rad_s, self.rate_hz)
        first = self.revolutions - len(vectors) + 1
        rows = [
            JudgedRevolution(first + i, moved[i], made.noise, terms[i], vectors.thrice[i])
            for i in range(EARLIER_SPEEDS, len(vectors))
        ]
        self._lessons.begin(made, rows)
        self._speeds = terms[-EARLIER_SPEEDS:, 0]

    def _learn(self, row: JudgedRevolution) -> None:
        """Learn again how 1X follows the speed, where it is time to."""
        assert self.calibration is not None  # noqa: S101 - only called after it was made
        learnt = self._lessons.add(row, self.calibration)
        if learnt is None:
            return
        self.calibration = self._healthy = learnt.calibration
        self._test = self._begun_test(learnt.calibration)
        for one in learnt.rows[learnt.of_baseline :]:
            self._add(one)
        self._rows = deque(learnt.rows, maxlen=_KEPT)
        self._previous = np.array([one.vector for one in learnt.rows[-2:]]) + learnt.calibration.baseline

    def _add(self, row: JudgedRevolution) -> DepartureEvidence:
        assert self._test is not None  # noqa: S101 - made with the calibration
        return self._test.add(row.vector, self._floored(row.noise), row.terms)

    def _begun_test(self, calibration: Calibration) -> DepartureTest:
        """The test of a healthy machine, after the revolutions that its baseline is made of."""
        threshold_nats = threshold_for(self.rules.false_alarms_per_1000_rev)
        test = self._new_test(threshold_nats, least=calibration.revolutions)
        # They are zero in the test's coordinates.
        for _ in range(calibration.revolutions):
            test.add(np.zeros(5, dtype=np.complex128), calibration.noise, self._lessons.baseline_terms)
        return test

    def _begin(self, calibration: Calibration) -> None:
        self.calibration = self._healthy = calibration
        self.rotor = calibration.rotor
        self.refused = ""
        self._test = self._begun_test(calibration)
        self._begun = self.revolutions - calibration.revolutions
        self._waiting.clear()

    def _new_test(self, threshold_nats: float, *, least: int) -> DepartureTest:
        assert self.calibration is not None  # noqa: S101 - only called after it was made
        spread = self._spread(self.calibration)
        if self._onset is not None:
            spread = replace(
                spread,
                variance=np.maximum(spread.variance, scatter(self._segment)),
                noise_variance=max(spread.noise_variance, noise_scatter(self._segment)),
            )
        return DepartureTest(
            spread,
            threshold_nats=threshold_nats,
            energy_threshold_nats=self.rules.energy_threshold_nats * threshold_nats / 20.0,
            least_reference=least,
        )

    def _spread(self, healthy: Calibration) -> Spread:
        """The scatter of a baseline's vectors, with what the rules add to it."""
        turn_rad = 2.0 * math.pi * self.rules.speed_uncertainty
        return replace(healthy.spread, drift=self.rules.probe_drift_um**2, turn_rad=turn_rad)

    def _tests(self, row: JudgedRevolution) -> bool:
        """Whether a revolution goes into a departure test: not while a new segment settles."""
        if self._onset is None:
            return True
        since = row.revolution - self._reference_from
        if self._beats:
            # What follows is compared with what comes after it; until then the rest is named without it.
            self._reference_from = row.revolution
            self._segment.clear()
            return False
        if since < _SETTLING:
            return False
        if since < _SETTLING + _LEAST_SEGMENT:
            self._segment.append(row)
            if since + 1 == _SETTLING + _LEAST_SEGMENT:
                self._test = self._new_test(_SEGMENT_THRESHOLD_NATS, least=_LEAST_SEGMENT)
                for earlier in self._segment:
                    self._add(earlier)
            return False
        return True

    @property
    def _beats(self) -> bool:
        """Whether a line beats with a harmonic without end, so that no two segments are alike."""
        now = self._identification
        if self._onset is None or now is None or now.line is None or not now.line.beats:
            return False
        return now.by_line or now.line.modulates is None

    def _changes_again(self, before: Identification | None, revolution: int) -> bool:
        """Begin a new segment where a line has ended, or a fault has begun or ended beside one.

        Args:
            before: the evaluation before.
            revolution: the present one.

        Returns:
            Whether it is another change, and not only the end of one.
        """
        now = self._identification
        if self._onset is None or before is None or now is None or before is now or before.line is None:
            return False
        ended = now.line is None
        if not ended:
            agreed = now.named and set(now.group) == set(now.candidates)
            was, self._was_line = self._was_line, now.by_line if agreed else self._was_line
            if was is None or was == self._was_line:
                return False
        self._onset = revolution - (_ENDED if ended else EVERY)
        self._reference_from, self._look = revolution, 0
        self._segment.clear()
        return not ended

    def _depart(self, onset: int, window: int) -> None:
        assert self._test is not None  # noqa: S101
        assert self.calibration is not None  # noqa: S101
        if self._onset is None:
            self._lessons.before(onset)
            before = self._reference = self._test.reference_before(window)
            self._healthy = with_more(
                self.calibration, self.calibration.baseline + before.vector, before.revolutions
            )
            self._middle = self._begun + before.revolutions / 2.0
            self._thrice = thrice_of([row for row in self._rows if row.revolution < onset])
            self._lines.depart(onset)
        self._onset, self._was_line = onset, None
        # A slow change is seen long after its onset: what came before belongs to the reference of before.
        self._reference_from = max(onset, onset + window - 1 - _SETTLING)
        self._look = 0
        self._segment.clear()

    def _maybe_look(self, revolution: int) -> bool:
        assert self._onset is not None  # noqa: S101
        since = revolution - self._onset + 1
        if since < self._next_look() and not (self._beats and since % EVERY == 0):
            return False
        while self._next_look() <= since:
            self._look += 1
        before = self._identification
        self._identify(revolution, may_name=since >= _NAMED_FROM)
        looks = (before, self._identification)
        if since >= _TRUSTED_FROM and all(one is not None and "normal" in one.candidates for one in looks):
            # One evaluation that sees nothing may be chance: with more evidence after it, it is one alarm.
            self._return_to_health()
        return True

    @property
    def _follows_transients(self) -> bool:
        """Whether the rotor is known well enough, and was healthy before."""
        known = max(self.rotor.natural_frequency_tolerance, self.rotor.damping_tolerance) <= KNOWN_WITHIN
        assert self.calibration is not None  # noqa: S101
        return known and self.calibration.laval

    def _next_look(self) -> int:
        if self._look < len(LOOKS):
            return LOOKS[self._look]
        return LOOKS[-1] + _LATER_LOOKS * (self._look - len(LOOKS) + 1)

    def finish(self) -> Identification | None:
        """A last evaluation, at the end of a recording."""
        if self._onset is not None:
            self._identify(self.revolutions, may_name=self.revolutions - self._onset + 1 >= _NAMED_FROM)
        return self._identification

    def _identify(self, revolution: int, *, may_name: bool) -> None:
        assert self._onset is not None  # noqa: S101
        assert self._healthy is not None  # noqa: S101
        assert self.calibration is not None  # noqa: S101
        since = revolution - self._onset + 1
        settled = self._onset + since // 3
        rows = [row for row in self._rows if row.revolution >= settled]
        if not rows:
            return
        vectors = np.array([row.vector for row in rows])
        terms = np.mean([row.terms for row in rows], axis=0)
        if self._reference is not None:
            terms = terms - self._reference.terms
        shift = self._healthy.baseline - self.calibration.baseline
        change = vectors.mean(axis=0) - shift
        spread = self._spread(self._healthy)
        law = None if spread.law is None else spread.law.over_swings()
        spread = replace(spread, variance=np.maximum(spread.variance, scatter(rows)), law=law)
        apart = float(np.mean([row.revolution for row in rows])) - self._middle
        variance = spread.of_means(float(len(rows)), float(self._healthy.revolutions), terms, apart)
        # Only the two modes of a run-up show how a force passes through the rotor at three times its speed.
        now = thrice_of(rows) if self._healthy.rotor.two_modes is not None else None
        if now is not None and self._thrice is not None:
            change = np.append(change, now.mean - self._thrice.mean)
            variance = np.append(variance, now.apart_from(self._thrice, self._healthy.amplitude_um))
        known = self._healthy
        orbit = HealthyOrbit(known.baseline, known.noise, known.rotor.clearance_um)
        found = self._lines.evaluate(revolution, orbit)
        self._identification = identify(
            change,
            variance,
            self._healthy,
            previous=self._identification,
            rules=self.rules.naming,
            may_name=may_name,
            comparison=self._comparison,
            energy=lasting_energy(rows, self._healthy) if since >= _NAMED_FROM else None,
            line=None if found is None else found.line,
            rest=None if found is None else self._without_line(found),
        )

    def _without_line(self, found: Found) -> WithoutLine | None:
        """The change of the harmonics without a line that beats with one of them."""
        assert self._healthy is not None  # noqa: S101
        healthy = self._healthy
        if not found.line.beats:
            return None
        spread = self._spread(healthy)
        rows = list(self._rows)[-found.revolutions :]
        terms = np.mean([row.terms for row in rows], axis=0)
        change = np.zeros(5, dtype=np.complex128)
        if found.harmonics is not None:
            change = at_speed(found.harmonics, terms, healthy) - healthy.baseline
        if self._reference is not None:
            terms = terms - self._reference.terms
        variance = spread.of_means(float(len(rows)), float(healthy.revolutions), terms)
        return WithoutLine(change, variance + (_LEFT_OF_LINE * found.line.amplitude_um) ** 2)

    def _return_to_health(self) -> None:
        assert self._healthy is not None  # noqa: S101
        self._onset, self._identification, self._alarm, self._comparison = None, None, None, None
        if self._reference is not None:
            self._lessons.into_baseline(self._reference.terms)
        self._begin(self._healthy)

    def _floored(self, noise: float) -> float:
        assert self.calibration is not None  # noqa: S101
        return max(noise, 1e-6 * self.calibration.amplitude_um**2)

    def _report(
        self, one: SynchronousVectors, evidence: DepartureEvidence | None, *, departed: bool, looked: bool
    ) -> WatchReport:
        return WatchReport(
            revolution=self.revolutions,
            end_index=int(one.end_index[0]),
            state=self.state,
            evidence=evidence,
            departed=departed,
            onset_revolution=self._onset,
            identification=self._identification,
            looked=looked,
            refused=self.refused,
        )
