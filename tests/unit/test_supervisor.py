"""Trying again, and talking about it once."""

from __future__ import annotations

import logging
import random
from typing import TYPE_CHECKING

from daqsvc.acquisition.supervisor import Backoff, Link

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
