"""What the detectors have against the sensors: the ground of quality alarms and of suppression."""

from __future__ import annotations

import math
import re
from collections import defaultdict, deque
from typing import TYPE_CHECKING, Any, NamedTuple, Self

from daqsvc.acquisition.clock import NS_PER_S
from daqsvc.acquisition.standing import cause_of, wording_of
from daqsvc.alarms.events import Doubt
from daqsvc.alarms.rules import RuleFinding
from daqsvc.alarms.states import Level
from daqsvc.diagnosis.record import NO_SAMPLES

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence
    from collections.abc import Set as AbstractSet

    from daqsvc.alarms.rules import Rule
    from daqsvc.diagnosis.record import Diagnosis

_CAUSE = re.compile(r" \(.*\)")
"""Why samples are missing, as it is written in the cause of an alarm."""

PREFIXES = ("sensor-ok/", "detector-ok/")
"""How the names of quality alarms begin."""


def quality_alarm(detector: str, sensors: Sequence[str]) -> str:
    """The quality alarm that a statement of ``detector`` is about; one that has failed names no sensors."""
    if len(sensors) == 1:
        return f"sensor-ok/{sensors[0]}"
    return f"detector-ok/{detector}"


LASTING = 8
"""Excess of partial statements over good ones that makes a quality alarm; as many good ones end it."""

SHARE_NS = 5 * NS_PER_S
"""The share of samples that a detector lacks is taken over so much time."""
MOST_LACKED = 0.1
"""A detector that lacked samples is good again when it lacks no larger share of them, ..."""
GOOD_NS = 3 * NS_PER_S
"""... and has been able to judge for so long."""


HEARD_NS = 10 * NS_PER_S
"""Samples come again, and no smaller share is missing: after so long that is the reason, not the silence."""

LONGEST_CAUSE = 160
"""A cause is compared with others by so many of its characters."""


UNHEARD_NS = 30 * NS_PER_S
"""After a restart a quality alarm waits at most so long for a statement of each of its detectors."""


class Lacking(NamedTuple):
    """What a detector has lacked in the last seconds: on this depends when its quality alarm returns.

    Attributes:
        weight: excess of partial statements over good ones, 0 to 8.
        lasts: whether partial statements prevail.
        times_ns: of its statements about samples in the last 5 s, by the monotonic clock of the box, ns.
        shares: share of the samples that was missing, 0 to 1, by statement.
        blind_ns: when it could judge nothing the last time, by the monotonic clock of the box, ns; null if
            that is over.
    """

    weight: int
    lasts: bool
    times_ns: list[int]
    shares: list[float]
    blind_ns: int | None

    @classmethod
    def of(cls, document: Mapping[str, Any]) -> Self:
        """What a file states.

        Raises:
            KeyError: something is missing.
            TypeError: something is of another type.
            ValueError: something cannot be.
        """
        blind_ns = document["blind_ns"]
        made = cls(
            int(document["weight"]),
            bool(document["lasts"]),
            [int(one) for one in document["times_ns"]],
            [float(one) for one in document["shares"]],
            None if blind_ns is None else int(blind_ns),
        )
        in_range = 0 <= made.weight <= LASTING and all(0.0 <= share <= 1.0 for share in made.shares)
        if not in_range or len(made.times_ns) != len(made.shares):
            raise ValueError(
                f"lacking: weight {made.weight}, {len(made.times_ns)} times: such shares cannot be"
            )
        return made


class Touched(NamedTuple):
    """What a statement is about.

    Attributes:
        alarms: names of quality alarms.
        sensors: those that it states, or no longer states, to be not OK.
    """

    alarms: tuple[str, ...]
    sensors: frozenset[str]


class _Patience:
    """Weighs the partial statements of a detector against the good ones.

    A frame lost now and then makes one window in some dozen partial. Its values are held, which is enough: a
    quality alarm with each of them would be a useless flood. It is raised when they prevail.
    """

    def __init__(self, *, lasting: bool) -> None:
        self.weight = LASTING if lasting else 0
        self.is_lasting = lasting

    def lasts(self, *, partial: bool) -> bool:
        """Take in a statement; whether samples are missing for good."""
        self.weight = min(max(self.weight + (1 if partial else -1), 0), LASTING)
        if self.weight in {0, LASTING}:
            self.is_lasting = self.weight > 0
        return self.is_lasting


class _Shortage:
    """The share of its samples that a detector has lacked in the last seconds.

    While frames are lost at random one window can be judged, and the next cannot: a quality alarm that went
    by each would come and go many times a second.
    """

    def __init__(self) -> None:
        self.shares: deque[tuple[int, float]] = deque()
        self.blind_ns: int | None = None

    def resume(self, t_ns: int) -> None:
        """Go on from before a restart at ``t_ns``: samples were lacking then."""
        self.blind_ns = t_ns

    def update(self, diagnosis: Diagnosis, share: float) -> None:
        """Take in a statement about samples, and what share of them is missing."""
        t_ns = diagnosis.t_ns
        if diagnosis.quality == "missing" and not diagnosis.partial:
            self.blind_ns = t_ns
        self.shares.append((t_ns, share))
        while t_ns - self.shares[0][0] >= SHARE_NS:
            self.shares.popleft()

    def lasts(self, t_ns: int) -> bool:
        """Whether a detector that can judge the samples until ``t_ns`` may soon be unable to."""
        if self.blind_ns is None:
            return False
        lacked = math.fsum(share for _, share in self.shares)
        lasts = t_ns - self.blind_ns < GOOD_NS or lacked > MOST_LACKED * len(self.shares)
        if not lasts:
            self.blind_ns = None
        return lasts


class SensorHealth:
    """What each detector has against its sensors, from a statement that is not good to the next good one.

    Missing samples do not take back that a sensor was not OK; a partial statement does, which has seen at
    least half of them. It raises its own doubt when such statements prevail, and upholds one that
    samples are missing. A detector that states what share of its samples is missing, and that could not judge
    them, is good again only when that has lasted for some seconds.
    """

    def __init__(self) -> None:
        self._patience: dict[str, _Patience] = {}
        self._shortage: defaultdict[str, _Shortage] = defaultdict(_Shortage)
        # When the restart was over which a detector lacked samples, until it states what share is missing.
        self._lacked_at_restart: dict[str, int] = {}
        self._by_detector: dict[str, tuple[str, Doubt]] = {}
        # Why there are no samples by which to judge, by detector, until it states good.
        self._causes: dict[str, str] = {}
        # After that, by detector, the least share that was missing since samples come again, and since when.
        self._lacking_since: dict[str, tuple[float, int]] = {}
        # By detector, the stream that it cannot judge by.
        self._unjudged: dict[str, str] = {}
        self._by_alarm: defaultdict[str, dict[str, Doubt]] = defaultdict(dict)
        # By sensor who blames it by name and why, the latest last; one without blame has no row.
        self._blamed: dict[str, dict[str, str]] = {}
        # Who may have joined in before a restart and has not spoken since, and until when that counts.
        self._unheard: set[str] = set()
        self._unheard_until_ns = 0
        self._unsettled: dict[str, set[str]] = {}
        self._unsettled_by: defaultdict[str, set[str]] = defaultdict(set)

    @property
    def not_ok_sensors(self) -> AbstractSet[str]:
        """The sensors that somebody blames by name, as it is at any time."""
        return self._blamed.keys()

    @property
    def unjudged_streams(self) -> dict[str, int]:
        """Streams without samples to judge by, with how many sensors rest on each."""
        sensors: defaultdict[str, set[str]] = defaultdict(set)
        for detector, stream in self._unjudged.items():
            if (doubted := self._by_detector.get(detector)) is not None:
                sensors[stream].update(doubted[1].sensors)
        return {stream: len(those) for stream, those in sorted(sensors.items())}

    def update(self, diagnosis: Diagnosis, now_ns: int) -> Touched:
        """Take in a statement; returns what it is about.

        Args:
            diagnosis: the statement.
            now_ns: monotonic time; of what was missed in a silence, all statements come when it ends.
        """
        detector = diagnosis.detector
        self._unjudged.pop(detector, None)
        name = quality_alarm(detector, diagnosis.sensors)
        before = self._forget(detector)
        self._unheard.discard(detector)
        # Of missing samples and a failure neither takes back the other: what is raised stays until good.
        sensors = tuple(diagnosis.sensors)
        if before is not None and diagnosis.quality != "not_ok" and not (before[1].sensors and sensors):
            name, sensors = before[0], before[1].sensors
        touched: set[str] = set() if before is None else _blames(before[1])
        if diagnosis.quality == "good" or diagnosis.partial:
            for alarm in self._unsettled_by.pop(detector, ()):
                self._unsettled[alarm].discard(detector)
        if (doubt := self._doubt(diagnosis, None if before is None else before[1])) is not None:
            doubt = doubt._replace(sensors=sensors)
            self._remember(name, doubt)
            touched |= _blames(doubt)
            if diagnosis.quality == "missing":
                self._note_cause(diagnosis, now_ns)
        else:
            self._causes.pop(detector, None)
            self._lacking_since.pop(detector, None)
        # A detector may rest on other sensors than before: then what it had against those is settled, too.
        alarms = (name,) if before is None or before[0] == name else (before[0], name)
        return Touched(alarms, frozenset(touched))

    def _note_cause(self, diagnosis: Diagnosis, now_ns: int) -> None:
        """Note why samples are missing: by this one reason is told from another, whatever the words."""
        detector = diagnosis.detector
        if diagnosis.end_index == diagnosis.first_index:
            self._causes[detector] = f" ({_cause_of_missing(diagnosis.reason)})"
            self._unjudged[detector] = diagnosis.stream
            self._lacking_since.pop(detector, None)
        elif detector in self._causes:
            # Where a mean of some values fills up, it will be good soon: that is no event of its own.
            share = 1.0 if diagnosis.missing_share is None else diagnosis.missing_share
            least, since_ns = self._lacking_since.get(detector, (math.inf, 0))
            if share < least:
                self._lacking_since[detector] = share, now_ns
            elif now_ns - since_ns >= HEARD_NS:
                del self._causes[detector]
                del self._lacking_since[detector]

    def _doubt(self, diagnosis: Diagnosis, before: Doubt | None) -> Doubt | None:
        """What stands against the sensors after a statement."""
        detector, good = diagnosis.detector, diagnosis.quality == "good"
        if diagnosis.partial and detector not in self._patience:
            self._patience[detector] = _Patience(lasting=detector in self._lacked_at_restart)
        lacked, lasts = before is not None and before.quality == "missing", False
        if detector in self._patience and (good or diagnosis.partial):
            lasts = self._patience[detector].lasts(partial=diagnosis.partial)
        if diagnosis.missing_share is not None and diagnosis.end_index > diagnosis.first_index:
            if (since_ns := self._lacked_at_restart.pop(detector, None)) is not None:
                self._shortage[detector].resume(since_ns)
            self._shortage[detector].update(diagnosis, diagnosis.missing_share)
        if good:
            lasts = lasts or (detector in self._shortage and self._shortage[detector].lasts(diagnosis.t_ns))
            # The samples that are there show that the sensor is OK.
            return before._replace(not_ok=False) if before is not None and lasts and lacked else None
        if diagnosis.partial and not (lasts or lacked):
            return None  # and the samples that are there show that the sensor is OK
        not_ok = diagnosis.quality == "not_ok" or (
            before is not None and before.not_ok and not diagnosis.partial
        )
        return Doubt(detector, diagnosis.quality, not_ok, diagnosis.reason, tuple(diagnosis.sensors))

    def resume(
        self, doubts: Iterable[Doubt], t_ns: int, finding: str = "", *, restarted: bool = True
    ) -> None:
        """Go on from before a restart, by ``t_ns``: what was lacking is good again when that has lasted.

        Args:
            doubts: what the doubts about the sensors were.
            t_ns: monotonic time now.
            finding: what the alarm was raised by, as `finding` names it: the same is no change.
            restarted: whether that may have been long ago. Else a silence is over with the first good
                statement, as it is without a restart.
        """
        causes = {
            part.partition("=")[0]: match[0] for part in finding.split("|") if (match := _CAUSE.search(part))
        }
        for doubt in doubts:
            if doubt.quality == "missing" and doubt.detector in causes:
                self._causes[doubt.detector] = causes[doubt.detector]
            if doubt.quality == "missing" and (restarted or doubt.detector not in causes):
                self._lacked_at_restart[doubt.detector] = t_ns
            self._forget(doubt.detector)
            self._unheard.discard(doubt.detector)
            self._remember(quality_alarm(doubt.detector, doubt.sensors), doubt)

    def lacking(self) -> dict[str, Lacking]:
        """What each detector has lacked in the last seconds, by its name; for `remember`."""
        lacking: dict[str, Lacking] = {}
        for detector in sorted(self._patience.keys() | self._shortage.keys()):
            patience = self._patience.get(detector) or _Patience(lasting=False)
            shortage = self._shortage.get(detector) or _Shortage()
            times_ns, shares = [t_ns for t_ns, _ in shortage.shares], [share for _, share in shortage.shares]
            lacking[detector] = Lacking(
                patience.weight, patience.is_lasting, times_ns, shares, shortage.blind_ns
            )
        return lacking

    def remember(self, lacking: Mapping[str, Lacking]) -> None:
        """Go on from what detectors have lacked until now, by the same clock; after `resume`."""
        for detector, was in lacking.items():
            patience = self._patience[detector] = _Patience(lasting=was.lasts)
            patience.weight = was.weight
            shortage = self._shortage[detector] = _Shortage()
            shortage.shares.extend(zip(was.times_ns, was.shares, strict=True))
            shortage.blind_ns = was.blind_ns
            self._lacked_at_restart.pop(detector, None)

    def settle(self, name: str) -> None:
        """Forget all that counts against the subject of the quality alarm ``name``."""
        for detector in [one for one, (alarm, _) in self._by_detector.items() if alarm == name]:
            self._forget(detector)
            self._lacked_at_restart.pop(detector, None)
            self._causes.pop(detector, None)
            self._lacking_since.pop(detector, None)
            self._unjudged.pop(detector, None)
            self._unheard.discard(detector)

    def not_ok(self) -> list[tuple[str, Doubt]]:
        """Who has found sensors not OK, each with the quality alarm that states it."""
        return [(name, doubt) for name, doubt in self._by_detector.values() if doubt.not_ok]

    def excuse(self, detector: str) -> None:
        """A detector has stated since that the sensors are OK."""
        if (before := self._forget(detector)) is not None:
            self._remember(before[0], before[1]._replace(not_ok=False))

    def expect(self, name: str, speakers: Mapping[str, Sequence[str]], t_ns: int) -> None:
        """Have the quality alarm ``name`` wait, after `resume`, for who may doubt its sensor, too.

        Who joins in or leaves with nothing new to state makes no event, so the journal may not know of it.

        Args:
            name: of the alarm.
            speakers: its detectors, with the sensors that they rest on.
            t_ns: monotonic time now.
        """
        doubts = self.of(name)
        if not doubts:
            return
        worst = _worst(doubts)
        # For a detector in the journal it is known what it doubts.
        for detector in speakers.keys() - self._by_detector.keys():
            self._unheard.add(detector)
            sensors = tuple(speakers[detector])
            # That it has silenced alarms, too, is not assumed.
            self._remember(name, worst._replace(detector=detector, not_ok=False, sensors=sensors))
        self._unheard_until_ns = t_ns + UNHEARD_NS

    def give_up(self, t_ns: int) -> list[str]:
        """Wait no longer for who has not spoken since a restart; the quality alarms that this touches."""
        if not self._unheard or t_ns < self._unheard_until_ns:
            return []
        forgotten = [self._forget(detector) for detector in sorted(self._unheard)]
        self._unheard.clear()
        return sorted({before[0] for before in forgotten if before is not None})

    def unsettle(self, rule: Rule) -> None:
        """The detector that found a sensor of ``rule`` not OK is gone: now its own must find them good."""
        self._unsettled[rule.alarm] = set(rule.detectors)
        for detector in rule.detectors:
            self._unsettled_by[detector].add(rule.alarm)

    def of(self, name: str) -> tuple[Doubt, ...]:
        """What counts against the subject of the quality alarm ``name``, by detector."""
        doubts = self._by_alarm.get(name, {})
        return tuple(sorted(doubt for detector, doubt in doubts.items() if detector not in self._unheard))

    def finding(self, name: str) -> RuleFinding:
        """What the quality alarm ``name`` is to state."""
        doubts = tuple(sorted((*self.of(name), *self._assumed(name))))
        if not doubts:
            return RuleFinding(Level.NORMAL, "good", lambda: f"{name.partition('/')[2]} is good again")
        parts = "|".join(
            f"{d.detector}={d.quality}{self._cause(d)}{'+not_ok' if d.not_ok else ''}" for d in doubts
        )
        # What samples lack, and for how long, is other words each time; what a sensor has is not.
        differs_by_words = _worst(doubts).quality == "not_ok"
        return RuleFinding(
            Level.ALERT, parts, lambda: in_words(name, doubts), differs_by_words=differs_by_words
        )

    def silences(self, rule: Rule, sensors: frozenset[str]) -> str | None:
        """Why the alarm of ``rule`` is suppressed while it rests on ``sensors``; None if it is not.

        Its own detector shows that a sensor is not OK, without stating which, or more of its sensors are
        blamed than it can spare.
        """
        if self._unsettled.get(rule.alarm):
            return "a sensor was not OK before the restart"
        if rule.spare == 0:
            for detector in rule.detectors:
                blamed = self._by_detector.get(detector)
                if blamed is not None and blamed[1].not_ok:
                    return _reason(blamed[1])
        lost = self._blamed.keys() & sensors if self._blamed else ()
        return next(reversed(self._blamed[min(lost)].values())) if len(lost) > rule.spare else None

    def _assumed(self, name: str) -> list[Doubt]:
        """What those may have against the subject who have not spoken since a restart."""
        doubts = self._by_alarm.get(name, {}) if self._unheard else {}
        return [doubt for detector, doubt in doubts.items() if detector in self._unheard]

    def _cause(self, doubt: Doubt) -> str:
        """Tells silence from a rate or counter that is wrong: one may take over from the other."""
        return self._causes.get(doubt.detector, "") if doubt.quality == "missing" else ""

    def _remember(self, name: str, doubt: Doubt) -> None:
        self._by_detector[doubt.detector] = (name, doubt)
        self._by_alarm[name][doubt.detector] = doubt
        for sensor in _blames(doubt):
            self._blamed.setdefault(sensor, {})[doubt.detector] = _reason(doubt)

    def _forget(self, detector: str) -> tuple[str, Doubt] | None:
        """Take back what a detector had against its sensors, and state what that was."""
        before = self._by_detector.pop(detector, None)
        if before is None:
            return None
        name, doubt = before
        _drop(self._by_alarm, name, detector)
        for sensor in _blames(doubt):
            _drop(self._blamed, sensor, detector)
        return before


def in_words(name: str, doubts: Sequence[Doubt]) -> str:
    """What the quality alarm ``name`` states of its subject while there are ``doubts``."""
    worst = _worst(doubts)
    what = "not OK"
    if worst.quality == "missing":
        what = "cannot be judged, and was not OK" if any(d.not_ok for d in doubts) else "cannot be judged"
    return f"{name.partition('/')[2]} {what}" + (f": {worst.reason}" if worst.reason else "")


def _cause_of_missing(reason: str) -> str:
    """What tells one reason why there are no samples from another.

    Figures do not. Of a doubt about samples nor does what comes behind the first of them.
    """
    if not reason.startswith(NO_SAMPLES):
        return cause_of(reason)
    return wording_of(reason)[:LONGEST_CAUSE].replace("|", "/")


def _worst(doubts: Sequence[Doubt]) -> Doubt:
    return min(doubts, key=lambda doubt: doubt.quality != "not_ok")


def _blames(doubt: Doubt) -> set[str]:
    """The sensor that a doubt blames, if it is a single one: of several it is not known which is not OK."""
    return {doubt.sensors[0]} if doubt.not_ok and len(doubt.sensors) == 1 else set()


def _reason(doubt: Doubt) -> str:
    return doubt.reason or "a sensor is not OK"


def _drop(table: dict[str, dict[str, Doubt]] | dict[str, dict[str, str]], key: str, detector: str) -> None:
    """Take a detector out of the row of ``key``, and the row with the last of them."""
    row = table[key]
    del row[detector]
    if not row:
        del table[key]
