"""When messages wait for company on their way to the disk."""

from __future__ import annotations

from daqsvc.outbox.writer import CROWD, CROWD_OVER_S, Crowd


def test_messages_that_come_alone_are_no_crowd():
    crowd = Crowd()
    for number in range(10 * CROWD):
        now_s = 2.0 * number * CROWD_OVER_S / CROWD
        assert not crowd.is_there(now_s)
        crowd.come(1, now_s)


def test_a_flood_is_a_crowd_until_it_ends():
    crowd = Crowd()
    now_s = 1000.0
    for _ in range(20):
        now_s += CROWD_OVER_S / 5
        crowd.come(CROWD, now_s)
    assert crowd.is_there(now_s)
    assert not crowd.is_there(now_s + 2.5 * CROWD_OVER_S)
