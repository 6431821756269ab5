"""Who has signed in, for as long as the page runs; and how often somebody may try."""

from __future__ import annotations

import hashlib
import secrets
import time
from collections import OrderedDict
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from collections.abc import Callable

IDLE_S = 8 * 3600.0
"""A session ends after so long without a request."""
LONGEST_S = 7 * 24 * 3600.0
"""And after so long in any case."""
MOST = 500
"""Sessions at a time; of more the one that was used longest ago ends."""
TRIES = 5
TRY_EVERY_S = 10.0
"""Number that may be made at once; one more is allowed each time this period passes."""
MOST_TRIERS = 2000


class Session(NamedTuple):
    """One who has signed in.

    Attributes:
        name: of the account.
        line: the account as it was then.
        begun_s: when, by the monotonic clock.
        used_s: when it was used last.
    """

    name: str
    line: str
    begun_s: float
    used_s: float


class Sessions:
    """Those who have signed in, by the secret that their browser has; kept here is only its hash.

    Args:
        now_s: the monotonic clock.
    """

    def __init__(self, now_s: Callable[[], float] = time.monotonic) -> None:
        self._now_s = now_s
        self._by_hash: OrderedDict[bytes, Session] = OrderedDict()

    def begin(self, name: str, line: str) -> str:
        """Begin one; the secret for the browser."""
        secret = secrets.token_urlsafe(32)
        now_s = self._now_s()
        self._by_hash[_hash(secret)] = Session(name, line, now_s, now_s)
        while len(self._by_hash) > MOST:
            self._by_hash.popitem(last=False)
        return secret

    def of(self, secret: str) -> Session | None:
        """The session with that secret; None if there is none, or it is over."""
        key = _hash(secret)
        session = self._by_hash.get(key)
        if session is None:
            return None
        now_s = self._now_s()
        if now_s - session.used_s > IDLE_S or now_s - session.begun_s > LONGEST_S:
            del self._by_hash[key]
            return None
        self._by_hash[key] = session._replace(used_s=now_s)
        self._by_hash.move_to_end(key)
        return session

    def end(self, secret: str) -> None:
        """End it."""
        self._by_hash.pop(_hash(secret), None)


class Tries:
    """How often each may try to sign in, by the account or the address.

    Args:
        now_s: the monotonic clock.
    """

    def __init__(self, now_s: Callable[[], float] = time.monotonic) -> None:
        self._now_s = now_s
        self._spent: OrderedDict[str, tuple[float, float]] = OrderedDict()
        """By who: how many tries are spent, and when that was."""

    def wait_s(self, *who: str) -> float:
        """How long these have to wait before the next try; 0 for not at all, and then it is counted."""
        now_s = self._now_s()
        spent = {one: self._spent_by(one, now_s) for one in who}
        wait_s = max((count - (TRIES - 1)) * TRY_EVERY_S for count in spent.values())
        if wait_s > 0:
            return wait_s
        for one, count in spent.items():
            self._spent[one] = (count + 1.0, now_s)
            self._spent.move_to_end(one)
        while len(self._spent) > MOST_TRIERS:
            self._spent.popitem(last=False)
        return 0.0

    def forget(self, *who: str) -> None:
        """They have signed in."""
        for one in who:
            self._spent.pop(one, None)

    def _spent_by(self, who: str, now_s: float) -> float:
        count, at_s = self._spent.get(who, (0.0, now_s))
        return max(count - (now_s - at_s) / TRY_EVERY_S, 0.0)


def _hash(secret: str) -> bytes:
    return hashlib.sha256(secret.encode("utf-8", "surrogatepass")).digest()
