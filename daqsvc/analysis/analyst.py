"""Analysts: from the path of a recording to what is printed about it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from daqsvc.analysis.many import Outcome
from daqsvc.analysis.rotor import analyse, refused
from daqsvc.recording.errors import RecordingError
from daqsvc.recording.recording import load_recording

if TYPE_CHECKING:
    from collections.abc import Callable

    from daqsvc.analysis.setup import RotorSetup


@dataclass(frozen=True, slots=True)
class RotorAnalyst:
    """Judges recordings of one rotor.

    Attributes:
        setup: what is known about it.
    """

    setup: RotorSetup

    def judge(
        self, recording: str, figures: str | None, progress: Callable[[int, int], None] | None = None
    ) -> Outcome:
        """See `daqsvc.analysis.many.Analyst.judge`."""
        try:
            loaded = load_recording(recording, self.setup.columns, self.setup.rate_hz)
        except RecordingError as error:
            analysis = refused(recording, self.setup, str(error))
        else:
            analysis = analyse(loaded, self.setup, progress)
            if figures is not None and analysis.trace is not None:
                from daqsvc.analysis.plots import draw  # noqa: PLC0415 - brings matplotlib

                draw(loaded, self.setup, analysis, figures)
        return Outcome(analysis.as_json(), analysis.describe(), analysis.refused is not None)
