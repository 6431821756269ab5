"""The checks of the soak themselves: what holds passes, and each thing that can go wrong is seen."""

from __future__ import annotations

import asyncio
import itertools
import json
import os
import random
import threading
from collections import Counter
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from soak.alarms import Cycle, Event, Evidence, Turn
from soak.books import Book, TrendBook
from soak.devices import MODULUS, Device
from soak.figures import MIB, Census, Trend, lowest
from soak.machines import ALARM
from soak.run import Soak

from daqsvc.diagnosis.pipeline import NICE, THREADS

SECOND_NS = 4 * 10**9
COUNTED = {"counter_restarts": 0, "frames_rejected": 0, "frames_set_aside": 0, "frames_late": 0}


class Stream:
    """What a sound service would say of a device's stream."""

    def __init__(self) -> None:
        self.device = Device("pump", 100.0, 1, seed=1)
        self.device.count = MODULUS + 5000
        self.book = Book("pump/casing", self.device)
        self.received, self.lost = 0, 0

    def comes(self, received: int, lost: int = 0) -> None:
        """Samples are lost, and some are received behind them."""
        self.received, self.lost = self.received + received, self.lost + lost

    def said(self, *, steady: bool = True, **changes: int) -> list[str]:
        """What the book finds in it."""
        counted: dict[str, Any] = COUNTED | {
            "samples_received": self.received,
            "samples_lost": self.lost,
            "end_index": 7 + self.received + self.lost,
        }
        shown = (MODULUS + 1000 + self.received + self.lost - 1) % MODULUS
        return list(self.book.enter(counted | changes, shown + changes.get("off", 0), 0, steady=steady))

    def cannot_send(self, begin: int, end: int) -> None:
        """Of its samples, counted as the service does."""
        self.device._miss(MODULUS + 1000 + begin, MODULUS + 1000 + end)


def test_books_that_fit_are_found_right() -> None:
    stream = Stream()
    assert list(stream.book.enter(COUNTED | dict.fromkeys(_KEYS, 0), None, 0, steady=False)) == []
    stream.comes(100)
    assert stream.said() == []
    stream.cannot_send(150, 170)
    stream.comes(200, 20)
    assert stream.said() == []
    stream.comes(300, 40)
    assert stream.said(steady=False) == []
    book = stream.book
    assert (book.received, book.lost, book.unsent, book.entries, book.steady_entries) == (600, 60, 20, 3, 1)


_KEYS = ("samples_received", "samples_lost", "end_index")


def test_each_sample_that_is_not_accounted_for_is_seen() -> None:
    stream = Stream()
    stream.comes(100)
    assert stream.said() == []
    stream.comes(100)
    assert "and 3 lost since number 7 do not come to number 207" in " ".join(stream.said(samples_lost=3))
    stream = Stream()
    stream.comes(100)
    stream.said()
    stream.comes(100)
    assert "3 samples are neither received nor lost" in " ".join(stream.said(off=3))
    stream.comes(100)
    assert "3 samples are accounted for twice" in " ".join(stream.said())
    stream.comes(100, 7)
    assert "7 samples were lost up to number" in " ".join(stream.said())
    stream.cannot_send(410, 420)
    stream.comes(100)
    assert "the device could not send 10 samples" in " ".join(stream.said(steady=False))
    stream.comes(100)
    assert "frames_rejected is 1, though" in " ".join(stream.said(frames_rejected=1))


def test_samples_from_before_anybody_listened_are_seen() -> None:
    stream = Stream()
    stream.device.disturb()
    stream.book = Book("pump/casing", stream.device)
    stream.comes(100)
    assert "taken before anybody listened" in " ".join(stream.said())


def test_a_trend_that_was_not_asked_for_so_often_is_seen() -> None:
    book = TrendBook("fan/temperature", asked_before=10)
    counted = {"samples_received": 8, "samples_lost": 2, "end_index": 10}
    assert list(book.enter(counted, 18)) == []
    assert "8 samples received, and its unit has answered 7 times" in " ".join(book.enter(counted, 17))
    assert "are not the 11 polls" in " ".join(book.enter(counted | {"end_index": 11}, 18))


def payload(number: int, level: str, before: str, **changes: Any) -> bytes:
    """An alarm event of the pump."""
    state = {"alert": "active_unacknowledged", "normal": "normal"}
    event = {
        "sequence": number,
        "id": f"series-{number}",
        "machine": "pump",
        "alarm": ALARM,
        "state": state[level],
        "level": level,
        "previous": {"state": state[before], "level": before},
        "monotonic_ns": number * SECOND_NS,
    }
    return json.dumps(event | changes).encode()


@pytest.fixture
def evidence() -> Evidence:
    """Of a soak in which all went well: it came and went twice."""
    told = Evidence()
    levels = ["normal", "alert", "normal", "alert", "normal"]
    for number, (before, level) in enumerate(itertools.pairwise(levels), 1):
        sent = payload(number, level, before)
        told.archive([Event.of(sent)])
        assert list(told.arrived(sent)) == []
        told.turns.append(Turn("pump", level == "alert", number * SECOND_NS, number * SECOND_NS + 5))
    return told


def test_alarms_that_all_came_are_found_right(evidence: Evidence) -> None:
    assert evidence.violations() == []
    assert list(evidence.arrived(payload(2, "normal", "alert"))) == []
    assert (evidence.repeats, evidence.violations(), evidence.read_to) == (1, [], 4)


def test_each_alarm_that_is_lost_or_wrong_is_seen(evidence: Evidence) -> None:
    def found() -> str:
        return " / ".join(evidence.violations())

    third = evidence.arrivals.pop("series-3")
    assert "number 3 (pump/shaking, active_unacknowledged) is in the journal and never reached" in found()
    evidence.forgotten.add(third.id)
    assert found() == ""
    evidence.arrivals[third.id] = third
    assert "came after number 4" in found()
    evidence.arrivals = dict(sorted(evidence.arrivals.items()))
    evidence.arrivals[third.id] = replace_digest(third)
    assert "with other bytes" in found()
    evidence.arrivals[third.id] = third
    twin = third._replace(id="other")
    evidence.journal["other"] = evidence.arrivals["other"] = twin
    assert "number 3 was given to other and to series-3" in found()
    del evidence.journal["other"]
    assert "reached the consumer and was never in the journal" in found()
    del evidence.arrivals["other"], evidence.journal[third.id], evidence.arrivals[third.id]
    assert "and it was ('normal', 'normal')" in found()
    assert "pump/shaking was raised between 12000000000 and 12000000005 ns, and no event" in found()
    assert "stands for two different events" in " ".join(evidence.arrived(payload(1, "alert", "alert")))


def replace_digest(event: Any) -> Any:
    return event._replace(digest=b"")


def test_a_turn_counts_when_it_is_on_the_disk() -> None:
    def status(level: str, waiting: int) -> dict[str, Any]:
        return {"alarms": {"standing": [{"alarm": ALARM, "level": level}]}, "outbox": {"waiting": waiting}}

    cycle = Cycle("pump", active=True, begun_ns=0)
    assert not cycle.look(status("normal", 0), 1)
    assert not cycle.look(status("alert", 0), 2), "it may be in memory only"
    assert not cycle.look(status("alert", 1), 3)
    assert cycle.look(status("alert", 0), 4)
    assert cycle.turns == [Turn("pump", active=True, begin_ns=0, end_ns=4)]
    assert (cycle.active, cycle.begun_ns) == (False, 4)


def test_memory_that_grows_is_told_from_memory_that_varies() -> None:
    rng = np.random.default_rng(1)
    t_s = np.arange(0.0, 600.0, 0.5)
    noise = rng.normal(scale=0.3 * MIB, size=len(t_s))
    flat = Trend.of(list(zip(t_s, 100 * MIB + noise, strict=True)))
    assert flat.violations() == []
    assert abs(flat.slope_mib_h) < flat.error_mib_h
    growing = Trend.of(list(zip(t_s, 100 * MIB + noise + 12 * MIB * t_s / 600.0, strict=True)))
    assert "memory grows by +" in growing.violations()[0]
    assert growing.slope_mib_h == pytest.approx(72.0, abs=2.0)
    leap = replace(flat, parts_mib=(100.0, 120.0))
    assert "memory was 100.0 MiB and is 120.0" in leap.violations()[0]
    with pytest.raises(ValueError, match="too few"):
        Trend.of([(0.0, 1)])


def test_a_device_that_was_not_played_sends_no_more_than_a_second_and_excuses_what_is_lost() -> None:
    device = Device("pump", 100.0, 10, seed=1)
    sent: list[int] = []
    device.send = lambda first, samples: (sent.extend(first.tolist()), np.ones(len(samples), np.bool_))[1]
    device._begun_s -= 50.0
    device.step()
    assert device.count - sent[0] == 100
    assert device.unsent(0, device.count) == sent[0]
    device.steady = True
    device.stand_still()
    device.read_to(device.count - 1)
    assert not device.steady
    device.read_to(device.count + 1)
    assert device.steady
    device.stand_still()
    device.disturb()
    device.read_to(device.count + 1)
    assert not device.steady, "a wire that is pulled meanwhile is another matter"


def test_a_thread_more_is_seen_and_how_many_compute_is_bounded_only() -> None:
    before = Census(10, 1, Counter({"a.db": 1}))
    assert before._replace(computing=THREADS).against(before) == ""
    assert before._replace(computing=0).against(before) == ""
    assert before._replace(threads=11).against(before) == "11 of threads, not 10"
    assert before._replace(descriptors=Counter()).against(before) == "0 of a.db, not 1"
    assert f"{THREADS + 1} threads that compute" in before._replace(computing=THREADS + 1).against(before)


async def test_threads_that_compute_are_told_by_their_lower_priority() -> None:
    over, under_way = threading.Event(), threading.Barrier(4)

    def wait(lower_by: int) -> None:
        me = threading.get_native_id()
        os.setpriority(os.PRIO_PROCESS, me, os.getpriority(os.PRIO_PROCESS, me) + lower_by)
        under_way.wait()
        over.wait()

    before = await lowest(os.getpid())
    threads = [threading.Thread(target=wait, args=(lower_by,)) for lower_by in (0, NICE, NICE)]
    for thread in threads:
        thread.start()
    under_way.wait()
    now = await lowest(os.getpid())
    over.set()
    for thread in threads:
        thread.join()
    assert (now.threads - before.threads, now.computing - before.computing) == (1, 2)


async def test_one_thing_that_befalls_it_does_so_again_and_again(monkeypatch: pytest.MonkeyPatch) -> None:
    plant: Any = SimpleNamespace(devices={})
    parts: Any = None
    one = Soak(Path(), 9.0, random.Random(1), plant, parts, parts, parts, None, {}, {}, ("process killed",))

    async def killed() -> None:
        one._begun_s -= 1.0

    monkeypatch.setattr(one, "killed", killed)
    monkeypatch.setattr(one, "count", lambda: asyncio.sleep(0))
    await one.befall()
    assert one.befell["process killed"] > 4
