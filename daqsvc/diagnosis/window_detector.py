"""What detectors have in common that judge each window by itself: subclass it and write `judge`."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass, field, replace
from numbers import Real
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from daqsvc.diagnosis.record import Diagnosis, Severity
from daqsvc.diagnosis.statements import see_names, see_numbers, see_severity, see_texts
from daqsvc.errors.machine_file import NO_SUCH_NAME, RING_TOO_SHORT, SAMPLED_APART
from daqsvc.settings.failures import BrokenContractError
from daqsvc.settings.problems import AssemblyError

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from daqsvc.acquisition.samples import Samples
    from daqsvc.diagnosis.detector import Window
    from daqsvc.dsp.quality import Quality
    from daqsvc.settings.models import MachineFile


_RING_WINDOWS = 2
"""Windows that a ring must hold at least."""


@dataclass(frozen=True, slots=True)
class Judgement:
    """What a window shows.

    Attributes:
        severity: how bad it is, ``"normal"``, ``"alert"`` or ``"danger"``; an alarm that follows the detector
            goes by it.
        statistics: what was measured, by name.
        decision: in a word; the severity unless given.
        units: of the statistics that have one.
        thresholds: what the statistics were compared with, by name.

    Raises:
        ValueError: there is no such severity, a figure, unit or decision is of another kind, a figure is not
            finite, a text cannot be sent, or there are too many of them.
    """

    severity: Severity
    statistics: Mapping[str, float] = field(default_factory=dict)
    decision: str = ""
    units: Mapping[str, str] = field(default_factory=dict)
    thresholds: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        see_severity(self.severity)
        for name in ("statistics", "units", "thresholds"):
            see_names(name, getattr(self, name))
        see_texts([("decision", self.decision), *self.units.items()])
        see_numbers([*self.statistics.items(), *self.thresholds.items()])


class WindowDetector(ABC):
    """Judges window after window of some sensors of one stream; holds its decision while samples are missing.

    Args:
        machine: the machine file.
        name: of the detector, as alarms follow it.
        sensors: names of its sensors, all in one stream.
        window_s: length of a window.

    Raises:
        AssemblyError: there is no such sensor, they are not all in one stream, or the ring does not hold two
            windows.
    """

    def __init__(self, machine: MachineFile, name: str, sensors: Sequence[str], window_s: float) -> None:
        known = {sensor.name: sensor for sensor in machine.sensors}
        for sensor in sensors:
            if sensor not in known:
                raise AssemblyError(
                    f"detector {name} ({type(self).__module__}.{type(self).__qualname__}) takes samples of "
                    f"{sensor!r:.60}, which is no sensor; name some of {', '.join(known)} in its table",
                    code=NO_SUCH_NAME,
                )
        resolved = [known[sensor] for sensor in sensors]
        streams = {sensor.stream for sensor in resolved}
        if len(streams) != 1:
            raise AssemblyError(
                f"detector {name} takes samples of one stream together, and its sensors "
                f"{', '.join(sensors)} are in {', '.join(sorted(streams)) or 'none'}; give it sensors of one",
                code=SAMPLED_APART,
            )
        ring_s = machine.pipeline.ring_s
        length: Any = window_s if isinstance(cast("object", window_s), Real) else math.nan
        if not 0.0 < length <= ring_s / _RING_WINDOWS:  # NaN is not, either
            raise AssemblyError(
                f"detector {name}: window_s is {window_s!r:.60}; make it a number above 0 and at most "
                f"{ring_s / _RING_WINDOWS:g}, so that a ring of {ring_s:g} s holds {_RING_WINDOWS} windows",
                code=RING_TOO_SHORT,
            )
        self.name = name
        self.stream = resolved[0].stream
        self.block = max(round(window_s * machine.streams[self.stream].rate_hz), 1)
        self._columns = [machine.column(sensor) for sensor in resolved]
        self._held = Diagnosis(
            machine.machine.name, name, 0, self.stream, 0, 0, "undetermined", sensors=tuple(sensors)
        )

    @abstractmethod
    def judge(self, samples: Samples) -> Judgement:
        """What a window shows.

        Args:
            samples: float32 ``[block, sensors]``, all finite; a block of a device that takes blocks by itself
                has its own length.
        """

    def warm(self) -> None:  # noqa: B027 - most have none
        """See `Detector.warm`: to be overridden by whoever compiles kernels."""

    def process(self, window: Window) -> Sequence[Diagnosis]:
        """See `Detector.process`."""
        length = len(window.samples) if window.snapshot else self.block
        return [self._state(window, at, length) for at in range(0, len(window.samples) - length + 1, length)]

    def silent(self, silence_s: float, t_ns: int) -> Sequence[Diagnosis]:
        """See `Detector.silent`."""
        reason = f"no samples have come of stream {self.stream} for {silence_s:.3g} s"
        return [replace(self._held, t_ns=t_ns, changed=False, quality="missing", reason=reason)]

    def _state(self, window: Window, at: int, length: int) -> Diagnosis:
        samples = window.samples[at : at + length, self._columns]
        after = len(window.samples) - at - length
        missing = float(np.mean(~np.isfinite(samples)))
        quality: Quality = "missing" if missing else "good"
        diagnosis = replace(
            self._held,
            t_ns=window.t_end_ns - round(after * window.period_ns),
            first_index=window.first_index + at,
            end_index=window.first_index + at + length,
            changed=False,
            quality=quality,
            reason=f"{100 * missing:.3g} % of the samples are missing" if missing else "",
            missing_share=missing,
        )
        if missing:
            return diagnosis
        judged = self.judge(samples)
        if not isinstance(judged, Judgement):
            raise BrokenContractError(self.judge, f"it returns {judged!r:.60}, not Judgement")
        decision = judged.decision or judged.severity
        changed = decision != self._held.decision
        self._held = replace(
            diagnosis,
            decision=decision,
            severity=judged.severity,
            statistics=judged.statistics,
            units=judged.units,
            thresholds=judged.thresholds,
            changed=changed,
        )
        return self._held
