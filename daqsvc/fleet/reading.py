"""The runner of `analyze`, as a worker needs it: one that can tell why a recording could not be read."""

from __future__ import annotations

from typing import TYPE_CHECKING

from daqsvc.dsp.quality import RefusedError
from daqsvc.fleet.failures import is_passing, was_killed
from daqsvc.offline.runner import Runner
from daqsvc.recording import RecordingError

if TYPE_CHECKING:
    from daqsvc.recording.recording import Recording


class PatientRunner(Runner):
    """A runner that reads once more where the process that reads was killed.

    Attributes:
        is_passing: whether the last recording could not be read for a reason that is not in it, so that
            another run may get further.
    """

    is_passing = False

    def load_by_rate(self, recording: str) -> list[Recording]:
        """See `Runner.load_by_rate`."""
        self.is_passing = False
        try:
            return super().load_by_rate(recording)
        except (RecordingError, RefusedError) as error:
            if not was_killed(error):
                self.is_passing = is_passing(error)
                raise
        try:
            return super().load_by_rate(recording)
        except (RecordingError, RefusedError) as error:
            self.is_passing = is_passing(error)
            raise
