"""The command line with small batches and its own patience; or a run whose workers a recording kills.

``fleet_program.py SECONDS VERB ...``, or ``fleet_program.py deadly ARCHIVE RESULTS``.
"""

from __future__ import annotations

import json
import os
import signal
import sys
from typing import TYPE_CHECKING

import daqsvc.fleet.campaign
import daqsvc.fleet.cluster
from daqsvc.cli import main
from daqsvc.confined.limits import ResourceLimits
from daqsvc.diagnosis.recorded import RecordingOptions
from daqsvc.fleet.archive import Archive
from daqsvc.fleet.campaign import Campaign, Wanted
from daqsvc.fleet.judging import judge_batch
from daqsvc.fleet.results import Results

if TYPE_CHECKING:
    from daqsvc.fleet.judging import Judged, RecordingBatch

daqsvc.fleet.campaign.MOST_RECORDINGS = 1


def deadly(batch: RecordingBatch) -> Judged:
    """What workers do; they die of a recording of this name."""
    if any(recording.file == "deadly.npz" for recording in batch.recordings):
        os.kill(os.getpid(), signal.SIGKILL)
    return judge_batch(batch)


def run_deadly(archive: str, results: str) -> int:
    """Judge an archive with workers that die."""
    daqsvc.fleet.campaign.MOST_RECORDINGS = 4
    wanted = Wanted(RecordingOptions(), ResourceLimits(), judge=deadly)
    with daqsvc.fleet.cluster.connected("local:2", 2) as client:
        summary = Campaign(Archive(archive), Results(results), wanted).run(lambda: client)
    print(json.dumps(summary.as_json()))  # noqa: T201 - the test reads it
    return 0


if __name__ == "__main__":
    if sys.argv[1] == "deadly":
        sys.exit(run_deadly(*sys.argv[2:]))
    daqsvc.fleet.cluster.CONNECT_S = float(sys.argv[1])
    sys.exit(main(sys.argv[2:]))
