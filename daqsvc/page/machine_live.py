"""What the page knows of one machine: what the service has sent since the first viewer came.

Nothing is kept over a restart, and of the waveforms no more than the last seconds.
"""

from __future__ import annotations

import base64
import json
import time
import zlib
from collections import deque
from itertools import takewhile
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np

from daqsvc.acquisition.clock import NS_PER_S
from daqsvc.acquisition.ring import SampleRing
from daqsvc.acquisition.samples import Quality, SampleBlock
from daqsvc.alarms.alarm import FINDINGS
from daqsvc.dsp.speed.keyphasor import EdgeFinder
from daqsvc.page.runs import Column, Runs

if TYPE_CHECKING:
    from collections.abc import Iterable
    from pathlib import Path

    from numpy.typing import NDArray

    from daqsvc.page.runs import SpectrumThen, Vectors

    Document = dict[str, Any]
    Samples = NDArray[np.float32]

KEEP_S = 20.0
"""Of the waveforms."""
MOST_VALUES = 4_000_000
"""Of one stream that are kept, at most."""
MOST_STATEMENTS = 3600
"""Statements of one detector that are kept."""
MOST_JOURNAL = 500
"""Alarm events that are kept."""
LEAST_WAVEFORM_HZ = 20.0
"""What is sampled more slowly is a trend value, and has no spectrum to look at."""
HYSTERESIS_V = 0.5
"""Of a keyphasor of which the machine file does not state it."""
PAIR = 2
SQUARE_DEG = (60.0, 120.0)
LATE_S = 3.0
LATE_TURNS = 3.0
"""A stream is late after so long, and so many times as long as it took the last time."""


class Sensor(NamedTuple):
    """A sensor, by the machine file.

    Attributes:
        name: its name.
        kind: ``"proximity"``, ``"accelerometer"``, ``"keyphasor"`` or another type.
        unit: of its samples.
        angle_deg: where a probe points, from +x anticlockwise; None for others.
        threshold: where a keyphasor's pulse begins; None for others.
        edge: the edge of that pulse that marks a revolution.
        hysteresis: how far the voltage must go back before the next one can come.
    """

    name: str
    kind: str
    unit: str
    angle_deg: float | None
    threshold: float | None
    edge: Literal["rising", "falling"]
    hysteresis: float


class ShortStatement(NamedTuple):
    """A statement, in short.

    Attributes:
        t_ns: of its last sample, by the box's monotonic clock.
        decision: what it decides.
        probabilities: by mode.
        statistics: its figures.
        evidence: what it rests on, nats.
    """

    t_ns: int
    decision: str
    probabilities: dict[str, float]
    statistics: dict[str, float]
    evidence: dict[str, float]


class _Came(NamedTuple):
    """When samples of a stream came last, and how long the next ones may take, by `time.monotonic`."""

    at_s: float
    patience_s: float


class Decided(NamedTuple):
    """What a detector decides.

    Attributes:
        decision: the same.
        since_ns: when it decided so first, by the box's monotonic clock.
        is_seen: whether it came while somebody looked; else it may be older.
    """

    decision: str
    since_ns: int
    is_seen: bool


class Earlier(NamedTuple):
    """Figures of a detector over time.

    Attributes:
        t_ns: ``[n]``, by the box's monotonic clock.
        values: ``[n, keys]``; NaN where a figure was not sent.
    """

    t_ns: NDArray[np.int64]
    values: NDArray[np.float64]


class SensorPlace(NamedTuple):
    """Where a sensor's samples come: a column of a stream, or of a grid."""

    stream: str
    column: int


class MachineLive:
    """One machine, as it was received.

    The event loop changes it, and threads read it meanwhile: they copy what they go through, by ``[*...]``.

    Args:
        about: the first line of `daqsvc.live_feed`.
    """

    def __init__(self, about: Document) -> None:
        self.about = about
        self.values: Document = about["values"]
        self.name: str = about["machine"]
        self.wall_ns_at_0: int = about["wall_ns_at_0"]
        self.sensors = {one["name"]: _sensor(one) for one in self.values.get("sensors", ())}
        self.rings: dict[str, SampleRing] = {}
        self.latest: dict[str, Document] = {one["detector"]: one for one in about["statements"]}
        self.probable = {name: one for name, one in self.latest.items() if one["probabilities"]}
        """By detector the last statement with probabilities: while data are missing there are none."""
        self.statements: dict[str, deque[ShortStatement]] = {}
        self.alarms: dict[str, Document] = {one["alarm"]: one for one in about["alarms"]}
        self.journal: deque[Document] = deque(sorted(about["alarms"], key=_when), MOST_JOURNAL)
        self._finding_messages = {
            name: str(one["message"]) for name, one in self.alarms.items() if one.get("kind") in FINDINGS
        }
        self.standings: dict[str, Document] = dict(about["standings"])
        self.history: Path | None = None
        """The file of the box's history, if there can be one."""
        self.earlier: dict[str, Earlier] = {}
        """By detector, probabilities of the time before anybody looked, once they were asked for."""
        self.left_out = 0
        self.note = ""
        """What a person has to know of all that is shown, e.g. that it is of the past; empty for nothing."""
        self._runs = Runs()
        self.token = zlib.crc32(json.dumps([self.values, about["streams"]], sort_keys=True).encode())
        """Different where the machine file is different."""
        self._came: dict[str, _Came] = {}
        self._places = self._sensor_places()
        self.decided: dict[str, Decided] = {
            name: Decided(str(one["decision"]), int(one["monotonic_ns"]), is_seen=False)
            for name, one in self.latest.items()
        }
        """By detector what it decides, and since when."""

    @property
    def measured_rpm(self) -> float | None:
        """What a detector has measured of the speed recently; None if none has."""
        for one in [*self.latest.values()]:
            measured = one["statistics"].get("speed")
            if measured is not None and one["units"].get("speed") == "rpm":
                return float(measured)
        return None

    @property
    def speed_rpm(self) -> float:
        """The speed as it was measured, or as the machine file states."""
        measured = self.measured_rpm
        return float(self.values["machine"].get("speed_rpm", 0.0)) if measured is None else measured

    @property
    def speed_in_words(self) -> str:
        """The speed, and whether it is only the machine file's; "" if none is stated."""
        measured = self.measured_rpm is not None
        return f"{self.speed_rpm:.0f} rpm{'' if measured else ' nominal'}" if self.speed_rpm else ""

    @property
    def turns_clockwise(self) -> bool:
        """Whether the shaft turns clockwise, seen from where the probes' angles are."""
        return bool(self.values["machine"].get("rotation") == "clockwise")

    def fault_of(self, detector: str, decision: str) -> str:
        """The fault that a decision of a detector means."""
        return str(self.about.get("faults", {}).get(detector, {}).get(decision, decision))

    def all_alarms(self) -> dict[str, Document | None]:
        """The last event of each alarm; None for one of the machine file that never had one."""
        return {str(one["name"]): None for one in self.values.get("alarms", ())} | self.alarms.copy()

    def hear(self, line: Document) -> None:
        """Take in a line of the feed after the first one."""
        if (samples := line.get("samples")) is not None:
            self._write(samples)
        elif (statement := line.get("statement")) is not None:
            self._take_statement(statement)
        elif (alarm := line.get("alarm")) is not None:
            self.alarms[alarm["alarm"]] = alarm
            if alarm.get("kind") in FINDINGS:
                self._finding_messages[alarm["alarm"]] = str(alarm["message"])
            self.journal.append(alarm)
        elif (standing := line.get("standing")) is not None:
            self.standings[standing["stream"]] = standing
        self.left_out += line.get("left_out", 0)

    def message_of(self, alarm: Document) -> str:
        """The last finding of an alarm, as far as it was received, and what was done about it since."""
        finding = str(alarm.get("found_message") or self._finding_messages.get(alarm["alarm"], ""))
        message = str(alarm["message"])
        return message if not finding or finding == message else f"{finding}; {message}"

    def go_on_from(self, before: MachineLive) -> None:
        """Keep what is known of the time before the connection was made again."""
        self.statements = before.statements
        self._finding_messages = before._finding_messages | self._finding_messages
        self.probable = before.probable | self.probable
        for detector, now in self.decided.items():
            if (known := before.decided.get(detector)) is not None and known.decision == now.decision:
                self.decided[detector] = known
        if self.about["begun_ns"] == before.about["begun_ns"]:  # else samples are counted again
            self.rings = before.rings
            self._runs = before._runs
        for event in before.journal:
            if event not in self.journal:
                self.journal.append(event)
        self.journal = deque(sorted(self.journal, key=_when), MOST_JOURNAL)

    def rate_hz(self, stream: str) -> float:
        """Samples per second of a stream, by the machine file."""
        return float(self.about["streams"][stream]["rate_hz"])

    def place_of(self, sensors: Iterable[str]) -> list[SensorPlace] | None:
        """Where sensors are sampled together; None if nowhere."""
        wanted = list(sensors)
        for there in self._places.values():
            if all(one in there for one in wanted):
                return [there[one] for one in wanted]
        return None

    def newest(self, stream: str, seconds: float) -> tuple[Samples, int] | None:
        """The last samples of a stream, ``[n, channels]``, and when the very last one was taken."""
        ring = self.rings.get(stream)
        if ring is None or not ring.started:
            return None
        count = min(round(seconds * self.rate_hz(stream)), ring.end_index - ring.oldest_index)
        return ring.read(ring.end_index - count, count), ring.time_of(ring.end_index - 1)

    def newest_of(self, sensor: str, seconds: float) -> tuple[NDArray[np.float64], float] | None:
        """The last samples of a sensor, ``[n]``, and its samples per second; None if none have come."""
        places = self.place_of([sensor])
        newest = None if places is None else self.newest(places[0].stream, seconds)
        if places is None or newest is None:
            return None
        return newest[0][:, places[0].column].astype(np.float64), self.rate_hz(places[0].stream)

    def vectors_of(self, sensor: str) -> Vectors:
        """1X of a sensor since somebody looks at it."""
        key = self.keyphasor()
        places = self.place_of([sensor, key]) if key else None
        if key is None or places is None:
            return self._runs.vectors(sensor, None, 0, EdgeFinder(0.0, 0.0, "rising"))
        keyphasor = self.sensors[key]
        finder = EdgeFinder(keyphasor.threshold or 0.0, keyphasor.hysteresis, keyphasor.edge)
        return self._runs.vectors(sensor, self._column(places[0]), places[1].column, finder)

    def spectra_of(self, sensor: str, window_s: float) -> list[SpectrumThen]:
        """Spectra of a sensor since somebody looks at it, the oldest first."""
        places = self.place_of([sensor])
        column = None if places is None else self._column(places[0])
        return self._runs.spectra(sensor, column, window_s, self.speed_rpm)

    def _column(self, place: SensorPlace) -> Column | None:
        ring = self.rings.get(place.stream)
        if ring is None or not ring.started:
            return None
        return Column(ring, place.column, self.rate_hz(place.stream))

    def newest_wall_ns(self, streams: Iterable[str]) -> int | None:
        """When the newest sample of streams was taken, ns since the Unix epoch; None if none has come."""
        rings = [self.rings[name] for name in streams if name in self.rings]
        newest = [ring.time_of(ring.end_index - 1) for ring in rings if ring.started]
        return max(newest) + self.wall_ns_at_0 if newest else None

    def silence(self, streams: Iterable[str]) -> tuple[str, float]:
        """Which of some streams has come no more, and for how long, s; "" if all come."""
        now_s = time.monotonic()
        for stream in streams:
            if self.standings.get(stream, {}).get("silent"):
                taken_ns = self.newest_wall_ns([stream])
                return stream, 0.0 if taken_ns is None else max(time.time() - taken_ns / NS_PER_S, 0.0)
            if (came := self._came.get(stream)) is not None and now_s - came.at_s > came.patience_s:
                return stream, now_s - came.at_s
        return "", 0.0

    def probes(self) -> list[tuple[str, str]]:
        """Pairs of proximity probes of one plane that are sampled together.

        Those that a detector takes as a pair; of the others each with the one of the most similar name that
        is 60 to 120 degrees from it.
        """
        declared = [table["probes"] for table in self._tables() if len(table.get("probes", ())) == PAIR]
        pairs = [(str(x), str(y)) for x, y in declared if self.place_of([x, y])]
        pairs = list(dict.fromkeys(pairs))
        left = [
            one
            for one in self.sensors.values()
            if one.kind == "proximity" and not any(one.name in pair for pair in pairs)
        ]
        while left:
            x = left.pop(0)
            others = [y for y in left if _are_square(x, y) and self.place_of([x.name, y.name])]
            if others:
                y = max(others, key=lambda other: _alike(x.name, other.name))
                left.remove(y)
                pairs.append((x.name, y.name))
        return pairs

    def _tables(self) -> list[Document]:
        return [one for one in self.values.get("pipeline", {}).values() if isinstance(one, dict)]

    def keyphasor(self) -> str | None:
        """The first keyphasor."""
        return next((one.name for one in self.sensors.values() if one.kind == "keyphasor"), None)

    def vibration_sensors(self) -> list[str]:
        """All sensors but keyphasors, by their names."""
        return [one.name for one in self.sensors.values() if one.kind not in {"keyphasor", "tachometer"}]

    def waveform_sensors(self) -> list[str]:
        """Those sensors of vibration that are sampled fast enough for a spectrum, by their names."""
        names = []
        for name in self.vibration_sensors():
            places = self.place_of([name])
            if places and self.rate_hz(places[0].stream) >= LEAST_WAVEFORM_HZ:
                names.append(name)
        return names

    def _sensor_places(self) -> dict[str, dict[str, SensorPlace]]:
        """By stream and grid, where each sensor's samples are in it."""
        places: dict[str, dict[str, SensorPlace]] = {}
        named: dict[str, str] = {}
        for stream, facts in self.about["streams"].items():
            if any(facts["sensors"]):
                pairs = zip(facts["sensors"], facts["channels"], strict=True)
                named |= {f"{stream}.{channel}": sensor for sensor, channel in pairs}
                places[stream] = {
                    sensor: SensorPlace(stream, column)
                    for column, sensor in enumerate(facts["sensors"])
                    if sensor
                }
        for stream, facts in self.about["streams"].items():
            if stream not in places:  # a grid
                columns = enumerate(named.get(channel, "") for channel in facts["channels"])
                places[stream] = {sensor: SensorPlace(stream, column) for column, sensor in columns if sensor}
        return places

    def _take_statement(self, statement: Document) -> None:
        detector, decision = statement["detector"], str(statement["decision"])
        if detector not in self.decided or self.decided[detector].decision != decision:
            is_seen = detector in self.latest
            self.decided[detector] = Decided(decision, int(statement["monotonic_ns"]), is_seen=is_seen)
        self.latest[detector] = statement
        if statement["probabilities"]:
            self.probable[detector] = statement
        statements = self.statements.setdefault(detector, deque(maxlen=MOST_STATEMENTS))
        statements.append(
            ShortStatement(
                statement["monotonic_ns"],
                statement["decision"],
                statement["probabilities"],
                statement["statistics"],
                statement.get("evidence", {}),
            )
        )

    def _write(self, samples: Document) -> None:
        self.place(
            SampleBlock(
                samples["stream"],
                samples["first_index"],
                np.frombuffer(base64.b64decode(samples["values"]), "<f4").reshape(samples["shape"]),
                samples["t_first_ns"],
                samples["period_ns"],
                quality=Quality(samples["quality"]),
            )
        )

    def place(self, block: SampleBlock) -> None:
        """Take in samples; what is there already is left out, what is missing before them is a gap."""
        now_s = time.monotonic()
        before = self._came.get(block.stream)
        took_s = 0.0 if before is None else now_s - before.at_s
        self._came[block.stream] = _Came(now_s, LATE_S + LATE_TURNS * took_s)
        ring = self.rings.get(block.stream)
        if ring is None:
            ring = self.rings[block.stream] = self._ring(block.stream, block.samples.shape[1])
        known = max(ring.end_index - block.first_index, 0) if ring.started else 0
        if known >= len(block.samples):
            return
        first_index = block.first_index + known
        ring.write(
            SampleBlock(
                block.stream,
                first_index,
                block.samples[known:],
                block.t_first_ns + round(known * block.period_ns),
                block.period_ns,
                first_index - ring.end_index if ring.started else 0,
                block.quality,
            )
        )

    def _ring(self, stream: str, channels: int) -> SampleRing:
        wanted = round(KEEP_S * self.rate_hz(stream))
        return SampleRing(
            stream, self.about["streams"][stream]["channels"], max(min(wanted, MOST_VALUES // channels), 1)
        )


def _alike(one: str, other: str) -> int:
    """How many characters two names have in common at their begin."""
    return sum(1 for _ in takewhile(lambda pair: pair[0] == pair[1], zip(one, other, strict=False)))


def _are_square(x: Sensor, y: Sensor) -> bool:
    """Whether two probes look at about a right angle."""
    apart = abs(((y.angle_deg or 0.0) - (x.angle_deg or 0.0) + 180.0) % 360.0 - 180.0)
    return SQUARE_DEG[0] <= apart <= SQUARE_DEG[1]


def _when(event: Document) -> int:
    return int(event["monotonic_ns"])


def _sensor(entry: Document) -> Sensor:
    angle, threshold = entry.get("angle_deg"), entry.get("threshold_v")
    edge: Literal["rising", "falling"] = "falling" if entry.get("edge") == "falling" else "rising"
    hysteresis = float(entry.get("hysteresis_v", HYSTERESIS_V))
    return Sensor(
        entry["name"], entry.get("type", ""), entry.get("unit", ""), angle, threshold, edge, hysteresis
    )
