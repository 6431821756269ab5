"""What detectors have in common that judge each window by itself: subclass it and write `judge`."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from daqsvc.diagnosis.record import Diagnosis

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from daqsvc.acquisition.samples import Samples
    from daqsvc.diagnosis.detector import Window
    from daqsvc.diagnosis.record import Severity
    from daqsvc.dsp.quality import Quality
    from daqsvc.settings.models import MachineFile


@dataclass(frozen=True, slots=True)
class Judgement:
    """What a window shows.

    Attributes:
        severity: how bad it is; an alarm that follows the detector goes by it.
        statistics: what was measured, by name.
        decision: in a word; the severity unless given.
    """

    severity: Severity
    statistics: Mapping[str, float] = field(default_factory=dict)
    decision: str = ""


class WindowDetector:
    """Judges window after window of some sensors of one stream; holds its decision while samples are missing.

    Args:
        machine: the machine file.
        name: of the detector, as alarms follow it.
        sensors: names of its sensors, all in one stream.
        window_s: length of a window.
    """

    def __init__(self, machine: MachineFile, name: str, sensors: Sequence[str], window_s: float) -> None:
        found = [machine.sensor(sensor) for sensor in sensors]
        self.name = name
        self.stream = found[0].stream
        self.block = max(round(window_s * machine.streams[self.stream].rate_hz), 1)
        self._columns = [machine.column(sensor) for sensor in found]
        self._held = Diagnosis(
            machine.machine.name, name, 0, self.stream, 0, 0, "undetermined", sensors=tuple(sensors)
        )

    def judge(self, samples: Samples) -> Judgement:
        """What a window shows.

        Args:
            samples: float32 ``[block, sensors]``, all finite; a block of a device that takes blocks by itself
                has its own length.
        """
        raise NotImplementedError

    def warm(self) -> None:
        """See `Detector.warm`: to be overridden by whoever compiles kernels."""

    def process(self, window: Window) -> Sequence[Diagnosis]:
        """See `Detector.process`."""
        length = len(window.samples) if window.snapshot else self.block
        return [self._state(window, at, length) for at in range(0, len(window.samples) - length + 1, length)]

    def silent(self, silence_s: float, t_ns: int) -> Sequence[Diagnosis]:
        """See `Detector.silent`."""
        reason = f"nothing has come of stream {self.stream} for {silence_s:.3g} s"
        return [replace(self._held, t_ns=t_ns, changed=False, quality="missing", reason=reason)]

    def _state(self, window: Window, at: int, length: int) -> Diagnosis:
        samples = window.samples[at : at + length, self._columns]
        after = len(window.samples) - at - length
        missing = float(np.mean(~np.isfinite(samples)))
        quality: Quality = "missing" if missing else "good"
        said = replace(
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
            return said
        judged = self.judge(samples)
        decision = judged.decision or judged.severity
        changed = decision != self._held.decision
        self._held = replace(
            said,
            decision=decision,
            severity=judged.severity,
            statistics=judged.statistics,
            changed=changed,
        )
        return self._held
