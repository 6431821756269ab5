"""Whether anything can be judged by a stream's samples, and why not: from its driver to whoever judges."""

from __future__ import annotations

import logging
import re
from typing import TYPE_CHECKING, NamedTuple, TypeAlias

from daqsvc.acquisition.clock import NS_PER_S
from daqsvc.errors.buses import NOT_BELIEVED
from daqsvc.errors.code import coded
from daqsvc.notice import notice

if TYPE_CHECKING:
    from collections.abc import Callable

logger = logging.getLogger(__name__)

QUIET_NS = 60 * NS_PER_S
"""A stream whose standing changes again and again is reported no more often than this."""

AGAIN_NS = NS_PER_S // 2
"""How often a doubt is repeated while frames come: if it is not, none come any more."""

PROVING_NS = 5 * NS_PER_S
"""Until then a stream's rate is either known, or it is not waited for."""


class StreamState(NamedTuple):
    """How a stream stands.

    Attributes:
        doubt: why nothing can be judged by its samples; empty if there is no evidence against them.
        proven: whether its rate seems to be the nominal one, or could not be found out in time.
        silent: whether the doubt is that nothing comes at all, since another doubt was active.
    """

    doubt: str = ""
    proven: bool = True
    silent: bool = False


_FIGURE = re.compile("[0-9]")
_NUMBER = re.compile(r"[-+]?\d[\d.,]*(e[-+]?\d+)?")

Tell: TypeAlias = "Callable[[str, StreamState], None]"
"""Called with the name of a stream and its standing whenever that changes; a doubt also while frames come."""


def tell_nobody(stream: str, standing: StreamState) -> None:
    """Takes no reports of the state of a stream."""


def cause_of(doubt: str) -> str:
    """What a doubt reports but for its figures, by which the same trouble may differ each time."""
    return _FIGURE.split(doubt, maxsplit=1)[0].strip()


def wording_of(message: str) -> str:
    """A message without its figures, which are others each time."""
    return _NUMBER.sub("#", message)


class StreamStanding:
    """Keeps a stream's standing, reports it when it changes, and logs it.

    Args:
        stream: name of the stream.
        tell: called when it changes, and every now and then while frames come of a stream in doubt.
    """

    def __init__(self, stream: str, tell: Tell) -> None:
        self._stream = stream
        self._tell = tell
        self._now: StreamState | None = None
        self._begun_ns: int | None = None
        self._reported_ns = 0
        self._logged_ns: dict[str, int] = {}
        self._logged = False

    def update(self, doubt: str, now_ns: int, *, known: bool) -> None:
        """Take in the state of the stream.

        Args:
            doubt: see `StreamState.doubt`.
            now_ns: arrival of its newest frame.
            known: whether its rate is known.
        """
        if self._begun_ns is None:
            self._begun_ns = now_ns
        proven = known or bool(doubt) or now_ns - self._begun_ns >= PROVING_NS
        if self._now is not None:
            proven = proven or self._now.proven
        standing = StreamState(doubt, proven)
        if standing == self._now and not (doubt and abs(now_ns - self._reported_ns) >= AGAIN_NS):
            return
        before, self._now = self._now, standing
        self._reported_ns = now_ns
        if cause_of(doubt) != cause_of(before.doubt if before else ""):
            self._log(doubt, now_ns)
        self._tell(self._stream, standing)

    def give_up_waiting(self) -> None:
        """Nothing more comes for now: what has come is to be judged as it is."""
        if self._now is not None and not self._now.proven:
            self._now = self._now._replace(proven=True)
            self._tell(self._stream, self._now)

    def _log(self, doubt: str, now_ns: int) -> None:
        if doubt:
            cause = cause_of(doubt)
            if now_ns - self._logged_ns.get(cause, now_ns - QUIET_NS) >= QUIET_NS:
                self._logged = True
                self._logged_ns[cause] = now_ns
                logger.warning(
                    "stream %r: %s. Nothing is judged by it meanwhile",
                    self._stream,
                    doubt,
                    extra=coded(NOT_BELIEVED),
                )
        elif self._logged:
            self._logged = False
            notice(logger, "stream %r: its samples can be judged by again", self._stream)
