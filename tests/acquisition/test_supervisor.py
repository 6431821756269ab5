"""Trying again, and talking about it once."""

from __future__ import annotations

import logging
import random
from typing import TYPE_CHECKING

from daqsvc.acquisition.link import Backoff, Link
from daqsvc.notice import NOTICE

if TYPE_CHECKING:
    import pytest

S = 1_000_000_000


def test_back_off_grows_to_its_limit_with_full_jitter() -> None:
    backoff = Backoff(first_ns=S, most_ns=30 * S, rng=random.Random(1))
    for limit_s in (1, 2, 4, 8, 16, 30, 30):
        assert 0 <= backoff.next_ns() <= limit_s * S
    late = [backoff.next_ns() for _ in range(1000)]
    assert min(late) < S
    assert max(late) > 29 * S
    backoff.reset()
    assert backoff.next_ns() <= S


def test_a_link_is_talked_about_once_each_way(caplog: pytest.LogCaptureFixture) -> None:
    link = Link("CAN bus 'can0'")
    with caplog.at_level(logging.INFO):
        link.up()
        for _ in range(3):
            link.down("the plug is out")
        link.up()
        link.up()
    assert [r.message for r in caplog.records] == [
        "CAN bus 'can0' is up",
        "CAN bus 'can0' is lost: the plug is out; it is being tried again",
        "CAN bus 'can0' is back",
    ]
    assert (link.state, link.losses, link.reason) == ("up", 1, "")


def test_a_link_that_comes_and_goes_does_not_fill_the_log(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    now_s = [100.0]
    monkeypatch.setattr("time.monotonic_ns", lambda: round(now_s[0] * S))
    link = Link("bus")
    for _ in range(100):
        link.up()
        now_s[0] += 0.1
        link.down("half a frame")
        now_s[0] += 0.1
    assert link.losses == 100
    often = "; if this repeats, it is logged three times a minute at most"
    said = [r.message for r in caplog.records if r.levelno >= NOTICE]
    assert [text for text in said if text != "bus is back"] == [
        "bus is lost: half a frame; it is being tried again",
        "bus is lost: half a frame; it is being tried again",
        f"bus is lost: half a frame; it is being tried again{often}",
    ]
    assert said.count("bus is back") == 3
    # One that stays away is said all the same, as soon as it may be.
    caplog.clear()
    for _ in range(60):
        now_s[0] += 1.0
        link.down("nobody answers")
    assert [r.message for r in caplog.records] == ["bus is lost: nobody answers; it is being tried again"]
    link.up()
    assert caplog.records[-1].message == "bus is back"
