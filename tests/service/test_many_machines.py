"""What each further machine takes of a service in a process of its own, apart from the processor."""

from __future__ import annotations

import time
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

import pytest
from support.many_machines import PER_BUS, SAMPLES_PER_FRAME, Watched, watched
from support.waiting import eventually_blocking

from daqsvc.diagnosis.pipeline import THREADS

if TYPE_CHECKING:
    from pathlib import Path

pytestmark = [pytest.mark.integration, pytest.mark.long]
SETTLED_S = 8.0
LOOKS, LOOK_S = 40, 0.05
"""A call that may block has a thread of its own for as long as it takes: many may have one at one time."""
LEAST = 640 * SETTLED_S / 2
MOST_FIRST_MB = 150.0
MOST_FURTHER_MB = 4.0


class Taken(NamedTuple):
    resident_mb: float
    threads: int
    descriptors: int


def lasting_threads(plant: Watched) -> int:
    """Threads that the service has at any time: the least of some looks."""
    looks = []
    for _ in range(LOOKS):
        looks.append(plant.threads())
        time.sleep(LOOK_S)
    return min(looks)


def taken(folder: Path, machines: int) -> Taken:
    """What so many machines take; whatever their devices send comes to every detector."""
    folder.mkdir()
    with watched(folder, machines) as plant:

        def figures(machine: int) -> dict[str, Any]:
            told: dict[str, Any] = plant.status(machine)["figures"]
            return told

        def has_received(machine: int) -> bool:
            return bool(figures(machine)["streams"]["shaft"]["samples_received"] > LEAST)

        def has_judged(machine: int, samples: int) -> bool:
            there = figures(machine)["detectors"].values()
            return all(one["samples"] + one["samples_withheld"] > samples - 640 for one in there)

        time.sleep(SETTLED_S)
        for machine in range(machines):
            eventually_blocking(partial(has_received, machine), "its device has sent for some seconds")
        found = Taken(plant.resident_mb(), lasting_threads(plant), plant.descriptors())
        sent = plant.silence()
        lost = 0
        for machine, samples in enumerate(sent.samples):
            eventually_blocking(
                partial(has_judged, machine, samples), "all that its device has sent is judged"
            )
            last = figures(machine)
            stream = last["streams"]["shaft"]
            assert stream["samples_received"] == samples
            lost += stream["samples_lost"]
            assert not any(one["samples_skipped"] for one in last["detectors"].values())
        # On a busy computer a bus may stand still for so long that devices find no room; else there is none.
        assert lost <= sent.refused * SAMPLES_PER_FRAME
    return found


def test_a_further_machine_takes_little_memory_no_thread_and_loses_nothing(tmp_path: Path) -> None:
    one, many = taken(tmp_path / "one", 1), taken(tmp_path / "many", 2 * PER_BUS)
    assert one.resident_mb <= MOST_FIRST_MB
    assert (many.resident_mb - one.resident_mb) / (2 * PER_BUS - 1) <= MOST_FURTHER_MB
    # A reader for the other bus; threads that compute are started when they are needed.
    assert many.threads - one.threads <= 1 + (THREADS - 1)
    # Its socket, and the one that it was made of.
    assert many.descriptors - one.descriptors <= 2
