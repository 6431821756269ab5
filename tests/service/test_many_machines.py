"""What each further machine takes of a service in a process of its own, apart from the processor."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, NamedTuple

import pytest
from support.many_machines import PER_BUS, watched

from daqsvc.diagnosis.pipeline import THREADS

if TYPE_CHECKING:
    from pathlib import Path

pytestmark = [pytest.mark.integration, pytest.mark.long]
SETTLED_S = 8.0
MOST_FIRST_MB = 150.0
MOST_FURTHER_MB = 4.0


class Taken(NamedTuple):
    resident_mb: float
    threads: int
    descriptors: int


def taken(folder: Path, machines: int) -> Taken:
    """What so many machines take; whatever their devices send comes to every detector."""
    folder.mkdir()
    with watched(folder, machines) as plant:
        time.sleep(SETTLED_S)
        found = Taken(plant.resident_mb(), plant.threads(), plant.descriptors())
        sent = plant.silence()
        assert not sent.refused
        for machine, samples in enumerate(sent.samples):
            figures = plant.status(machine)["figures"]
            stream = figures["streams"]["shaft"]
            assert samples > 640.0 * SETTLED_S / 2
            assert (stream["samples_received"], stream["samples_lost"]) == (samples, 0)
            for name, detector in figures["detectors"].items():
                assert detector["samples_skipped"] == 0
                assert detector["samples"] + detector["samples_withheld"] > samples - 640, name
    return found


def test_a_further_machine_takes_little_memory_no_thread_and_loses_nothing(tmp_path: Path) -> None:
    one, many = taken(tmp_path / "one", 1), taken(tmp_path / "many", 2 * PER_BUS)
    assert one.resident_mb <= MOST_FIRST_MB
    assert (many.resident_mb - one.resident_mb) / (2 * PER_BUS - 1) <= MOST_FURTHER_MB
    # A reader for the other bus; threads that compute are started when they are needed.
    assert many.threads - one.threads <= 1 + (THREADS - 1)
    # Its socket, and the one that it was made of.
    assert many.descriptors - one.descriptors <= 2
