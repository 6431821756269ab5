"""Keeping a link up: when to try again, and how often an unstable link may be logged."""

from __future__ import annotations

import logging
import random
import time
from collections import deque
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal

from daqsvc.acquisition.clock import NS_PER_S
from daqsvc.errors.buses import DRIVER_FAILED, LEFT_OUT_AT_START, LINK_LOST
from daqsvc.errors.code import coded
from daqsvc.notice import notice
from daqsvc.settings.failures import cause_of, in_words

if TYPE_CHECKING:
    from collections.abc import Callable, Hashable, Mapping

    from daqsvc.errors.code import Code

logger = logging.getLogger(__name__)

LOGGED_AT_MOST, LOGGED_WITHIN_NS = 3, 60 * NS_PER_S

OFTEN = "; if this repeats, it is logged three times a minute at most"
"""To be added to what is logged for the third time."""


class Sparing:
    """Lets a trouble be logged three times a minute at most, and its end only if the trouble was logged."""

    def __init__(self) -> None:
        self._logged_ns: deque[int] = deque(maxlen=LOGGED_AT_MOST)
        self._standing = False

    @property
    def often(self) -> bool:
        """Whether nothing more is logged for now."""
        return len(self._logged_ns) == LOGGED_AT_MOST

    def may_say(self) -> bool:
        """Whether the trouble that there is now is to be logged; if so, it counts as logged.

        To be asked again while it lasts: what could not be logged at first can be later.
        """
        if self._standing:
            return False
        # Real time, whatever the service's clock is: this is about how much goes into the log.
        now_ns = time.monotonic_ns()
        if self.often and now_ns - self._logged_ns[0] < LOGGED_WITHIN_NS:
            return False
        while self._logged_ns and now_ns - self._logged_ns[0] >= LOGGED_WITHIN_NS:
            self._logged_ns.popleft()
        self._logged_ns.append(now_ns)
        self._standing = True
        return True

    def may_take_back(self) -> bool:
        """Whether the end of the trouble is to be logged: once, if the trouble was."""
        was, self._standing = self._standing, False
        return was


LOG_AGAIN_S = 3600.0
"""The same failure is logged again after so long."""


class LoggedOnce:
    """Lets each failure be logged once an hour, by what caused it."""

    def __init__(self) -> None:
        self._logged_s: dict[Hashable, float] = {}

    def may_say(self, cause: Hashable) -> bool:
        """Whether a failure is to be logged; if so, it counts as logged."""
        now_s = time.monotonic()
        logged_s = self._logged_s.get(cause)
        if logged_s is not None and now_s - logged_s < LOG_AGAIN_S:
            return False
        self._logged_s[cause] = now_s
        return True


LinkState = Literal["down", "up"]


class Backoff:
    """Exponential back-off with full jitter: a random wait up to a ceiling that doubles.

    Args:
        first_ns: first ceiling.
        most_ns: highest ceiling.
        rng: source of the jitter.
    """

    def __init__(
        self, first_ns: int = NS_PER_S // 4, most_ns: int = 30 * NS_PER_S, rng: random.Random | None = None
    ) -> None:
        self._first_ns = first_ns
        self._most_ns = most_ns
        self._ceiling_ns = first_ns
        # Jitter spreads reconnects, it keeps no secret.
        self._rng = rng or random.Random()  # noqa: S311

    @property
    def ceiling_ns(self) -> int:
        """The longest that the next wait may be."""
        return self._ceiling_ns

    def next_ns(self) -> int:
        """How long to wait before the next try."""
        wait_ns = self._rng.randint(0, self._ceiling_ns)
        self._ceiling_ns = min(2 * self._ceiling_ns, self._most_ns)
        return wait_ns

    def reset(self) -> None:
        """It worked: begin again at the first ceiling."""
        self._ceiling_ns = self._first_ns


@dataclass(slots=True)
class Link:
    """The state of one link, logged once when it goes and once when it is back.

    Of one that keeps failing that is logged three times a minute at most.

    Attributes:
        name: what a person calls it.
        state: up or down.
        losses: how often it went down after it had been up.
        reason: why it is down.
        code: of the kind of reason; None while it is up, or was stopped.
        over: why nothing more comes over it, in a clause with its name; empty while it is up or tried again.
        turns: how often the thread that reads it has come round, whether there was anything or not; it does
            so several times a second. 0 where the event loop reads.
        faults: by stream, why no samples of it come while the link is up, in a clause, e.g. that the device
            refuses what is asked.
        quiet: that nothing at all comes over it, in a clause; empty if something does, or that is not known.
        preparing: whether the driver still makes itself ready, so that nothing can have come yet.
    """

    name: str
    state: LinkState = "down"
    losses: int = 0
    reason: str = ""
    code: Code | None = None
    over: str = ""
    turns: int = 0
    faults: Mapping[str, str] = field(default_factory=dict)
    quiet: Callable[[], str] = field(default=str, repr=False)
    preparing: bool = False
    _ever_up: bool = field(default=False, repr=False)
    _logged_down: bool = field(default=False, repr=False)
    _sparing: Sparing = field(default_factory=Sparing, repr=False)
    _failures: LoggedOnce = field(default_factory=LoggedOnce, repr=False)

    @property
    def ever_up(self) -> bool:
        """Whether the link has worked before."""
        return self._ever_up

    def up(self) -> None:
        """The link works."""
        if self._logged_down:
            notice(logger, "%s is back" if self._ever_up else "%s is there now", self.name)
        elif self.state == "down":
            logger.info("%s is up", self.name)
        self._sparing.may_take_back()
        self.state, self.reason, self._logged_down, self._ever_up = "up", "", False, True
        self.code = None
        self.over = ""

    def down(self, reason: str) -> None:
        """The link does not work, because of ``reason``, and is tried again; repeated calls are silent."""
        if self.state == "up":
            self.losses += 1
        if not self._logged_down and self._sparing.may_say():
            lost = " is lost" if self._ever_up else ""
            often = OFTEN if self._sparing.often else ""
            logger.warning(
                "%s%s: %s; it is being tried again%s", self.name, lost, reason, often, extra=coded(LINK_LOST)
            )
            self._logged_down = True
        self.state, self.reason, self.code = "down", reason, LINK_LOST

    def fail(self, reason: str, error: BaseException) -> None:
        """The driver has failed unexpectedly, and begins again; logged once an hour."""
        if self.state == "up":
            self.losses += 1
        if self._failures.may_say(cause_of(error)):
            logger.error(
                "%s: %s; it is being tried again", self.name, in_words(error), extra=coded(DRIVER_FAILED)
            )
            logger.info("traceback of that failure", exc_info=error)
            self._logged_down = True
        self.state, self.reason, self.code = "down", reason, DRIVER_FAILED

    def leave_out(self, reason: str) -> None:
        """The link does not work at start, because of ``reason``, and is not tried again."""
        left_out = f"{self.name}: {reason}; it is left out until the service starts again"
        logger.warning("%s, as start = 'ignore' asks for", left_out, extra=coded(LEFT_OUT_AT_START))
        self.state, self.reason, self._logged_down, self.over = "down", reason, False, left_out
        self.code = LEFT_OUT_AT_START

    def end(self, reason: str) -> None:
        """There is nothing more to come over the link, because of ``reason``; it is not tried again."""
        ended = f"{self.name} has ended: {reason}"
        logger.info("%s", ended)
        self.state, self.reason, self._logged_down, self.over = "down", reason, False, ended
        self.code = None

    def why_silent(self, stream: str) -> str:
        """Why no samples of a stream come, in a clause, as far as that is known; else empty."""
        return self.reason if self.state == "down" else self.faults.get(stream, "")

    def turn(self) -> None:
        """The thread that reads has come round once more; called on it."""
        self.turns += 1

    def stop(self) -> None:
        """The link is not kept up any more: its driver was stopped. That is no loss."""
        if self.state == "up":
            self.state, self.reason, self.code = "down", "it was stopped", None
