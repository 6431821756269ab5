"""What comes and goes fills no log, and is said all the same when it stays."""

from __future__ import annotations

from typing import TYPE_CHECKING

from daqsvc.acquisition.link import Sparing

if TYPE_CHECKING:
    import pytest

S = 1_000_000_000


def test_three_times_a_minute_and_its_end_as_often(monkeypatch: pytest.MonkeyPatch) -> None:
    now_s = [5.0]
    monkeypatch.setattr("time.monotonic_ns", lambda: round(now_s[0] * S))
    sparing = Sparing()
    said = ended = 0
    for _ in range(300):
        said += sparing.may_say()
        assert not sparing.may_say(), "it lasts, and has been said or must not be"
        now_s[0] += 0.05
        ended += sparing.may_take_back()
        assert not sparing.may_take_back()
        now_s[0] += 0.05
    assert (said, ended) == (3, 3)
    assert sparing.often
    asked_s = [now_s[0] + k for k in range(60)]
    heard = []
    for now_s[0] in asked_s:
        heard.append(sparing.may_say())
    assert sum(heard) == 1, "one that stays is said once, as soon as it may be"
