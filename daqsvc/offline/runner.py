"""One runner over recordings: it reads them, has every detector of a machine file judge them, and joins that.

The machine file is one on disk, or one that options make in memory (`daqsvc.offline.machine_options`).
"""

from __future__ import annotations

import multiprocessing
import os
import signal
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, TypeAlias, cast

import numpy as np

from daqsvc import kernel_cache
from daqsvc.detectors.shaft.verdict import RotorVerdict
from daqsvc.diagnosis.recorded import Recorded, worst
from daqsvc.dsp.quality import RefusedError
from daqsvc.dsp.quality.rate import SAME_RATE
from daqsvc.dsp.quality.recorded import known_against
from daqsvc.errors.command_line import PROCESS_LOST
from daqsvc.recording import RecordingError
from daqsvc.recording.contents import left_out
from daqsvc.recording.formats import named_as_can_log
from daqsvc.recording.formats.column_units import unit_in_name
from daqsvc.recording.recording import (
    get_limits,
    list_channels,
    load_matching,
    load_recording,
    matching,
    set_limits,
)
from daqsvc.settings.failures import one_line
from daqsvc.settings.models import ProximityProbe
from daqsvc.settings.plugins import configured, detector_tables
from daqsvc.settings.problems import AssemblyError
from daqsvc.settings.units import factor_between
from daqsvc.snapshots.contents import SUFFIX as SNAPSHOT_SUFFIX

if TYPE_CHECKING:
    from collections.abc import Callable, Container, Iterable, Iterator, Mapping, Sequence
    from multiprocessing.synchronize import Lock

    from daqsvc.confined.limits import ResourceLimits
    from daqsvc.diagnosis.plugin import DetectorPlugin
    from daqsvc.diagnosis.recorded import (
        Evaluated,
        Progress,
        RecordedDetector,
        RecordingOptions,
        Verdict,
    )
    from daqsvc.recording.recording import Recording
    from daqsvc.settings import MachineFile

_BLAS_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")

Detectors: TypeAlias = "dict[str, RecordedDetector[Any]]"
"""By the key of their table, in the order of their places."""


class WorkerLostError(Exception):
    """A process died that was working on a recording."""

    code = PROCESS_LOST


@dataclass(frozen=True, slots=True)
class Outcome:
    """What is printed about a recording.

    Attributes:
        json: the JSON object.
        text: the same in words.
        refused: whether the recording could not be judged.
    """

    json: dict[str, Any]
    text: str
    refused: bool


class Runner:
    """Judges recordings of one machine. In another process it is made there, machine file and all.

    A sensor's samples are the variable that ``options.channels`` states, else the one with the sensor's name,
    else the one with its channel's name. Detectors whose sensors the recording lacks are left out. The
    recording's sampling rate replaces that of the streams. If a recording has several rates, the sensors of
    each are judged by the detectors that read them.

    Args:
        make: makes the machine file, once a process.
        options: what is stated of the recordings.
        detectors: makes the detectors; unless given, those of the machine file's tables.
        machine: the machine file, where it has been made in this process.
    """

    def __init__(
        self,
        make: Callable[[], MachineFile],
        options: RecordingOptions,
        detectors: Callable[[MachineFile, RecordingOptions], Detectors] | None = None,
        machine: MachineFile | None = None,
    ) -> None:
        self._make = make
        if machine is not None:
            self.machine = machine
        self._make_detectors = detectors
        self.options = options

    def __reduce__(self) -> tuple[Any, ...]:
        """What makes it, for the models of the machine's tables are made where it is read."""
        return type(self), (self._make, self.options, self._make_detectors)

    @cached_property
    def machine(self) -> MachineFile:
        """The machine file.

        Raises:
            MachineFileError: it cannot be used.
        """
        return self._make()

    @cached_property
    def detectors(self) -> Detectors:
        """Its detectors.

        Raises:
            ValueError: what they or the options name does not fit the machine, or cannot be used.
        """
        if self._make_detectors is not None:
            return self._make_detectors(self.machine, self.options)
        return detectors_of(self.machine, self.options)

    def prepare(self) -> None:
        """See whether the options fit the machine, and make its detectors.

        Raises:
            ValueError: they do not, or what they name cannot be used.
            MachineFileError: the machine file cannot be used.
        """
        machine = self.machine
        names = {name for sensor in machine.sensors for name in (sensor.name, sensor.channel)}
        if not self.options.in_memory and (odd := [n for n in self.options.channels if n not in names]):
            raise ValueError(
                f"--map names {odd[0]!r}, which is no sensor of {machine.path}; there are "
                f"{', '.join(sensor.name for sensor in machine.sensors)}"
            )
        _ = self.detectors

    def judge(self, recording: str, figures: str | None, progress: Progress | None = None) -> Outcome:
        """Judge the recording at a path.

        Args:
            recording: the file, a CAN log, or a folder of CAN logs.
            figures: what the names of its figures begin with; None: no figures.
            progress: called with the samples done and the samples in all.
        """
        try:
            loaded, *slower = self.load_by_rate(recording)
        except (RecordingError, RefusedError) as error:
            refused = _not_judged(self.detectors, recording, str(error))
            return self._outcome(replace(refused, code=error.code), {})
        recordings = [loaded, *slower]
        homes = {key: _home(one, recordings) for key, one in self.detectors.items()}
        names = [name for one in recordings for name in one.names]
        lacking = (
            one.left_out(homes[key].names if one.part else names) for key, one in self.detectors.items()
        )
        notes = [*loaded.notes, *map(one_line, filter(None, lacking))]
        present: Detectors = {}
        evaluated: dict[str, Evaluated] = {}
        wrong = ""
        for key, one, judges in self._judging(recordings, homes):
            present[key] = self.detectors[key]
            try:
                judged = judges(progress)
            except (ValueError, AssemblyError) as error:
                why = one_line(str(error))
                if one is loaded or self.detectors[key].part:
                    wrong = why
                else:
                    notes.append(f"{key} has not judged {', '.join(one.names)}: {why}")
                continue
            evaluated[key] = _joined(evaluated[key], judged) if key in evaluated else judged
            if figures is not None and judged.draw is not None:
                judged.draw(figures)
        if wrong:
            return self._outcome(_not_judged(present, recording, wrong), evaluated, notes)
        heads = _heads({key: one for key, one in present.items() if key in evaluated})
        verdicts = [verdict for key in heads.values() if (verdict := evaluated[key].verdict) is not None]
        if not verdicts:
            verdicts = [RotorVerdict(recording=recording, quality=known_against(loaded))]
        for one in slower:
            verdicts[0] = replace(verdicts[0], quality=verdicts[0].quality.joined(known_against(one)))
        others = {key: one for key, one in evaluated.items() if key not in heads.values()}
        return self._outcome(verdicts[0], evaluated, notes, verdicts[1:], others)

    def _judging(
        self, recordings: Sequence[Recording], homes: Mapping[str, Recording]
    ) -> Iterator[tuple[str, Recording, Callable[[Progress | None], Evaluated]]]:
        """What judges what: the key of a detector, one of the recordings, and the call.

        Args:
            recordings: one for each rate.
            homes: by detector the one that it gives its verdict about; without a verdict, it judges all.
        """
        for one in recordings:
            tables, machine = self._as_recorded(one)
            for key, settings in tables.items():
                detector = self.detectors[key]
                if not detector.part or homes[key] is one:
                    recorded = Recorded(machine, one, detector.options)
                    yield key, one, partial(detector.evaluate, recorded, settings)

    def _outcome(
        self,
        first: Verdict,
        evaluated: Mapping[str, Evaluated],
        notes: Iterable[str] = (),
        verdicts: Sequence[Verdict] = (),
        others: Mapping[str, Evaluated] | None = None,
    ) -> Outcome:
        """What is printed.

        Args:
            first: the verdict about the first part of the machine.
            evaluated: what all detectors brought forward.
            notes: what a person should know of the recording, in sentences.
            verdicts: about the other parts.
            others: the detectors that give none of these; None: all.
        """
        json = first.as_json()
        if self.options.in_memory:
            return Outcome(json, first.describe(), first.refused is not None)
        quality = json["data_quality"]
        quality["problems"] = list(dict.fromkeys([*notes, *quality["problems"]]))
        texts = [first.describe()]
        statement = [
            statement
            for one in (evaluated if others is None else others).values()
            for statement in one.statements
        ]
        texts += [one.describe() for one in statement]
        for verdict in verdicts:
            json[verdict.part] = verdict.as_json()
            texts.append(f"{verdict.part}s of {verdict.describe()}")
        json["detectors"] = {
            each.detector: each.as_json() for one in evaluated.values() for each in one.statements
        }
        if alarmed := worst(statement):
            texts.insert(1, f"worst of the other detectors: {alarmed}")
        texts[1:1] = [note for note in notes if note not in texts[0]]
        return Outcome(json, "\n  ".join(texts), first.refused is not None)

    def _as_recorded(self, recording: Recording) -> tuple[dict[str, Any], MachineFile]:
        """The tables that a recording suffices for, and the machine with these, its sensors and its rate."""
        tables = {key: one.as_recorded(recording.names) for key, one in self.detectors.items()}
        machine = self.machine
        update = {
            "sensors": tuple(sensor for sensor in machine.sensors if sensor.name in recording.names),
            "streams": {
                name: stream.model_copy(update={"rate_hz": recording.rate_hz})
                for name, stream in machine.streams.items()
            },
            "pipeline": machine.pipeline.model_copy(update=tables),
        }
        present = {key: table for key, table in tables.items() if table is not None}
        return present, machine.model_copy(update=update)

    def load(self, recording: str, only: Sequence[str]) -> Recording:
        """Some sensors of the machine in a recording, by their names.

        Args:
            recording: path of the recording: a file, a CAN log, or a folder of CAN logs.
            only: names of the sensors that are wanted.

        Raises:
            RecordingError: it cannot be read.
            RefusedError: it lacks a sensor that is wanted.
        """
        options = self.options
        if options.in_memory:
            return self._of_options(recording, narrow=False)
        if not _is_can_log(recording):
            columns = self._columns(recording, list_channels(recording))
            self._refuse_lacking(recording, only, columns)
            wanted = {name: columns[name] for name in only}
            return self._in_its_units(load_recording(recording, wanted, options.rate_hz))
        loaded = self._of_can_log(recording, only)[0]
        self._refuse_lacking(recording, only, loaded.names)
        samples = loaded.samples[:, [loaded.names.index(name) for name in only]]
        return replace(
            loaded,
            names=tuple(only),
            samples=samples,
            nan_count=int(np.isnan(samples).sum()),
            infinity_count=int(np.isinf(samples).sum()),
        )

    def load_by_rate(self, recording: str) -> list[Recording]:
        """The sensors of the machine in a recording, by their names: those of each rate together.

        Args:
            recording: path of the recording: a file, a CAN log, or a folder of CAN logs.

        Returns:
            First the one with the sensors of the verdict; without any, the one of the highest rate.
            Its notes state what else could not be read.

        Raises:
            RecordingError: the first cannot be read.
            RefusedError: it lacks a sensor that the verdict needs, or there is none at all.
        """
        if self.options.in_memory:
            return [self._of_options(recording, narrow=True)]
        if _is_can_log(recording):
            loaded = self._of_can_log(recording, _watched(self.detectors))
            self._refuse_lacking(recording, _needs(self.detectors), loaded[0].names)
            return loaded
        there = list_channels(recording)
        columns, *others = self._groups(self._columns(recording, there), there)
        first = self._in_its_units(load_recording(recording, columns, self.options.rate_hz, narrow=True))
        known = {sensor.name for sensor in self.machine.sensors}
        beside = {name: name for name in first.of_other_rates if name in known}
        others += self._groups(beside, {}, by_rate=True)
        notes = _without_others(first)
        notes += left_out({name: why for name, why in first.of_other_rates.items() if name not in known})
        loaded = [first]
        for group in others:
            try:
                one = self._in_its_units(load_recording(recording, group, narrow=True))
                self._refuse_other_rate(one)
            except (RecordingError, RefusedError) as error:
                notes.append(one_line(f"left out {', '.join(group)}: {error}"))
            else:
                notes += [note for note in _without_others(one) if note not in notes]
                loaded.append(replace(one, notes=()))
        loaded[0] = replace(first, notes=tuple(notes))
        return loaded

    def _refuse_other_rate(self, recording: Recording) -> None:
        """Refuse channels at another rate than the machine file states of them.

        Raises:
            RefusedError: they are.
        """
        stated_hz = self._rate_of(recording.names[0])
        if abs(recording.rate_hz / stated_hz - 1.0) > SAME_RATE:
            raise RefusedError(
                f"the rate is {recording.rate_hz:g} Hz by the file and {stated_hz:g} Hz by "
                f"{self.machine.path}; correct rate_hz of the stream"
            )

    def _rate_of(self, sensor: str) -> float:
        """Samples per second of a sensor by the machine file."""
        return self.machine.streams[self.machine.sensor(sensor).stream].rate_hz

    def _groups(
        self, columns: Mapping[str, str], there: Mapping[str, int], *, by_rate: bool = False
    ) -> list[dict[str, str]]:
        """The variables of sensors that are read together, as they have one length and rate.

        Args:
            columns: the variable of each sensor.
            there: the samples of each variable of the file.
            by_rate: whether sensors of one length may have several rates.

        Returns:
            First those that the verdict rests on, else those of the highest rate.
        """
        lengths = {there[variable] for variable in columns.values() if variable in there}
        if len(lengths) <= 1 and not by_rate:
            return [dict(columns)]
        keys = {name: (self._rate_of(name), there.get(variable, 0)) for name, variable in columns.items()}
        watched = [name for name in _watched(self.detectors) if name in columns]
        keys |= dict.fromkeys(watched, keys[watched[0]]) if watched else {}
        first = [keys[watched[0]]] if watched else []
        ordered = dict.fromkeys([*first, *sorted(keys.values(), reverse=True)])
        return [{name: columns[name] for name in columns if keys[name] == key} for key in ordered]

    def _of_options(self, recording: str, *, narrow: bool) -> Recording:
        """The sensors that options name."""
        wanted = {sensor.name: sensor.channel for sensor in self.machine.sensors}
        load = load_matching if self.options.patterns else load_recording
        return self._in_its_units(load(recording, wanted, self.options.rate_hz, narrow=narrow))

    def _of_can_log(self, recording: str, watched: Sequence[str]) -> list[Recording]:
        """See `load_can_rates`."""
        options = self.options
        if options.channels or options.unit is not None:
            raise RefusedError(
                f"{recording} is a CAN log, of which the machine file states channels and units: leave out "
                f"{'--map' if options.channels else '--unit'}"
            )
        from daqsvc.offline.can_logs import load_can_rates  # noqa: PLC0415 - brings python-can and kernels

        return load_can_rates(self.machine, recording, options.rate_hz, watched)

    def _in_its_units(self, recording: Recording) -> Recording:
        """A recording whose units are not contradicted by its file.

        Raises:
            RefusedError: they are.
        """
        for sensor in self.machine.sensors:
            stated = recording.units.get(sensor.name, "")
            unit = sensor.unit
            if isinstance(sensor, ProximityProbe) and self.options.unit is not None:
                unit = self.options.unit
            if factor_between(stated, unit) not in {None, 1.0}:
                raise RefusedError(
                    f"{sensor.name} of {recording.source} is in {stated} by the file, and would be read "
                    f"in {unit}; state the file's unit (--unit, or the sensor's in the machine file), or "
                    f"save it in {unit}"
                )
        return recording

    def _refuse_lacking(self, recording: str, wanted: Iterable[str], there: Container[str]) -> None:
        """Refuse a recording without a sensor that is wanted.

        Raises:
            RefusedError: it lacks one.
        """
        lacking = [name for name in wanted if name not in there]
        if lacking and _is_can_log(recording):
            raise RefusedError(
                f"{recording} holds no samples of {', '.join(lacking)} of {self.machine.path}; give the log "
                "of its bus too, in one folder"
            )
        if lacking:
            raise RefusedError(
                f"{recording} has no channel for {', '.join(lacking)} of {self.machine.path}; name its "
                f"variable, e.g. --map {lacking[0]}=VARIABLE"
            )

    def _columns(self, recording: str, there: Mapping[str, int]) -> dict[str, str]:
        """The variable of each sensor that a recording has.

        Args:
            recording: its path.
            there: its channels.

        Raises:
            RecordingError: it cannot be read.
            RefusedError: it lacks a sensor that the verdict needs, or has none at all.
        """
        channels, columns = self.options.channels, {}
        for sensor in self.machine.sensors:
            mapped = channels.get(sensor.name, channels.get(sensor.channel))
            if mapped is not None:
                columns[sensor.name] = matching(recording, mapped, there)
            elif sensor.name in there:
                columns[sensor.name] = sensor.name
            elif sensor.channel in there:
                columns[sensor.name] = sensor.channel
            else:
                # As a table's header names it, with the unit in brackets.
                names = {sensor.name, sensor.channel}
                named = [one for one in there if unit_in_name(one)[0] in names]
                columns |= {sensor.name: named[0]} if len(named) == 1 else {}
        missing = [name for name in _needs(self.detectors) if name not in columns]
        if missing and recording.endswith(SNAPSHOT_SUFFIX):
            # Of a snapshot the fastest streams are read, and the others where they are asked for by name.
            return {name: channels.get(name, name) for name in _needs(self.detectors)}
        if missing or not columns:
            missing = missing or [sensor.name for sensor in self.machine.sensors]
            lacking = [sensor for sensor in self.machine.sensors if sensor.name in missing]
            # A variable of that name may be there and be no channel: then the reader states why.
            list_channels(recording, [name for sensor in lacking for name in (sensor.name, sensor.channel)])
            raise RefusedError(
                f"{recording} has no channel for {', '.join(missing)} of {self.machine.path}; name its "
                f"variable, e.g. --map {missing[0]}=VARIABLE. It holds {', '.join(there) or 'no channel'}"
            )
        return columns


def _is_can_log(path: str) -> bool:
    """Whether a recording is a CAN log by its ending, or a folder of such."""
    return Path(path).is_dir() or named_as_can_log(Path(path))


def detectors_of(machine: MachineFile, options: RecordingOptions) -> Detectors:
    """The detectors of a machine file, for recordings; a calibration is for the first that can have one.

    Raises:
        ValueError: what they or the options name cannot be used.
    """
    chosen: Detectors = {}
    calibration = options.calibration
    for key, table, settings in configured(machine.pipeline):
        plugin = cast("DetectorPlugin[Any]", table)
        chosen[key] = plugin.recorded(
            machine, settings, replace(options, calibration=calibration if plugin.calibrated else None)
        )
        if plugin.calibrated:
            calibration = None
    if calibration is not None:
        raise ValueError(
            f"--calibration: {machine.path} has neither {' nor '.join(calibrated_tables())} that would use "
            "it; add it"
        )
    return chosen


def calibrated_tables() -> list[str]:
    """The tables of a machine file whose detectors can be calibrated."""
    return [
        f"[pipeline.{key}]"
        for key, table in detector_tables().items()
        if cast("DetectorPlugin[Any]", table).calibrated
    ]


def _heads(detectors: Detectors) -> dict[str, str]:
    """The detector that gives the verdict of each part of the machine, the first part first."""
    return {one.part: key for key, one in detectors.items() if one.part}


def _watched(detectors: Detectors) -> tuple[str, ...]:
    """The sensors that the first verdict rests on; without one, those that any detector needs."""
    heads = [detectors[key].sensors for key in _heads(detectors).values()]
    return next(
        (sensors for sensors in (*heads, *(one.sensors for one in detectors.values())) if sensors), ()
    )


def _joined(one: Evaluated, other: Evaluated) -> Evaluated:
    """What a detector brings forward about the channels of two rates."""
    return replace(one, statements=(*one.statements, *other.statements))


def _without_others(recording: Recording) -> list[str]:
    """The notes of a recording, but for those on channels of other rates, which are read, too."""
    others = left_out(recording.of_other_rates)
    return [note for note in recording.notes if note not in others]


def _home(detector: RecordedDetector[Any], recordings: Sequence[Recording]) -> Recording:
    """Which of the recordings of several rates a detector gives its verdict about."""
    having = (one for one in recordings if set(detector.sensors).intersection(one.names))
    return next(having, recordings[0])


def _needs(detectors: Detectors) -> tuple[str, ...]:
    """The sensors without which a recording is refused: those that the first verdict rests on."""
    head = next((detectors[key] for key in _heads(detectors).values()), None)
    return () if head is None or head.takes_fewer else head.sensors


def _not_judged(detectors: Detectors, recording: str, why: str) -> Verdict:
    """The verdict about a recording that cannot be judged, with the keys that one about it would have."""
    for key in _heads(detectors).values():
        verdict = detectors[key].not_judged(recording, why)
        if verdict is not None:
            return verdict
    return RotorVerdict.not_judged(recording, why)


class Judge(Protocol):
    """Judges a recording; goes to another process by pickle. `Runner` is one."""

    def judge(self, recording: str, figures: str | None, progress: Progress | None = None) -> Outcome:
        """See `Runner.judge`."""
        ...


def judge_all(
    judge: Judge, recordings: Sequence[str], figures: Sequence[str | None], processes: int
) -> Iterator[Outcome]:
    """Outcomes in the order of the recordings, each as soon as it and all before it are there.

    Args:
        judge: judges them.
        recordings: the files.
        figures: for each, what the names of its figures begin with.
        processes: how many at a time; with one, this process does it.

    Raises:
        WorkerLostError: a process was killed.
    """
    if processes == 1:
        for recording, prefix in zip(recordings, figures, strict=True):
            yield judge.judge(recording, prefix)
        return
    # One process a core: threads of the linear algebra inside each would only get in each other's way.
    for name in _BLAS_THREADS:
        os.environ.setdefault(name, "1")
    context = multiprocessing.get_context("spawn")
    initargs = (judge, get_limits(), context.Lock())
    pool = ProcessPoolExecutor(processes, context, initializer=_prepare, initargs=initargs)
    try:
        jobs = [pool.submit(_judge, *job) for job in zip(recordings, figures, strict=True)]
        for recording, job in zip(recordings, jobs, strict=True):
            try:
                yield job.result()
            except BrokenProcessPool:
                raise WorkerLostError(
                    f"a process was killed while {recording} was waited for (out of memory?); "
                    "give fewer --jobs"
                ) from None
    finally:
        pool.shutdown(cancel_futures=True)


_judges: list[Judge] = []
"""In a process of the pool: the one that judges there, so that what it has read is read once."""


def _judge(recording: str, figures: str | None) -> Outcome:
    return _judges[0].judge(recording, figures)


def _prepare(judge: Judge, limits: ResourceLimits, compiling: Lock) -> None:
    """Read as the parent would; and leave Ctrl-C, which goes to the whole group, to it.

    Args:
        judge: judges the recordings.
        limits: of reading them.
        compiling: the process that acquires it states that kernels are compiled.
    """
    _judges.append(judge)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    set_limits(limits)
    kernel_cache.prepare(say=False, first=partial(compiling.acquire, block=False))
