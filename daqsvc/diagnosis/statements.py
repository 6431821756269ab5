"""Asking detectors: what they return is what their contract declares, or their authors are named."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from numbers import Integral, Real
from typing import TYPE_CHECKING, Any, TypeVar, get_args

from daqsvc.acquisition.clock import NS_PER_S
from daqsvc.diagnosis.record import Diagnosis, Severity, is_text
from daqsvc.dsp.quality import Quality
from daqsvc.settings.failures import BrokenContractError, is_ours
from daqsvc.settings.problems import choice

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from daqsvc.diagnosis.detector import Detector, Window

T = TypeVar("T")

MOST_FIGURES = 1000
"""Statistics, and thresholds, of a statement at most."""
MOST_CHARACTERS = 200
"""Length of a name, a unit and a decision at most."""
MOST_WORDS = 2000
"""Characters of a reason, and of what an exception of a detector reports, at most."""
_AHEAD_NS = NS_PER_S
"""How far the time of a statement may be ahead of the last sample of its window."""
_QUALITIES = get_args(Quality)
_CONTROL = re.compile(r"[\x00-\x1f\x7f-\x9f\ud800-\udfff]")

_BEHIND_NS = 3600 * NS_PER_S
"""How old the last sample of what is stated of a window may be."""


def window_statements(detector: Detector, window: Window) -> Sequence[Diagnosis]:
    """What a detector states about a window.

    Raises:
        BrokenContractError: these are no statements, or they cannot be sent.
        Exception: it has failed.
    """
    latest_ns = window.t_end_ns
    return _checked(detector.process, latest_ns - _BEHIND_NS, latest_ns, window)


def silence_statements(detector: Detector, silence_s: float, t_ns: int) -> Sequence[Diagnosis]:
    """What a detector states about a silence.

    Raises:
        BrokenContractError: these are no statements, or they cannot be sent.
        Exception: it has failed.
    """
    return _checked(detector.silent, min(0, t_ns), t_ns, silence_s, t_ns)


def _checked(
    say: Callable[..., Sequence[Diagnosis]], earliest_ns: int, latest_ns: int, *of: Any
) -> Sequence[Diagnosis]:
    statements = asked(say, *of)
    if not isinstance(statements, Sequence) or not all(isinstance(one, Diagnosis) for one in statements):
        raise BrokenContractError(say, f"it returns {statements!r:.60}, not Sequence[Diagnosis]")
    if not is_ours(getattr(say, "__module__", None) or ""):
        try:
            for one in statements:
                see_statement(one, earliest_ns, latest_ns)
        except ValueError as error:
            raise BrokenContractError(say, f"it returns a statement that cannot be sent: {error}") from None
    return statements


def asked(hook: Callable[..., T], *of: Any) -> T:
    """What a detector answers; whatever ends its code is a failure like any other, with words to be logged.

    Raises:
        Exception: it has failed.
    """
    try:
        return hook(*of)
    except BaseException as error:
        words = _words(error)
        if isinstance(error, Exception) and words is not None:
            raise
        kind = type(error).__name__
        detail = "" if words is None else f": {words}" if words else ""
        raise RuntimeError(f"it raises {kind}{detail}").with_traceback(error.__traceback__) from None


def _words(error: BaseException) -> str | None:
    """What an exception of a detector states; None if it cannot be logged, sent or written down."""
    try:
        words = str(error)
        return words if is_text(words, MOST_WORDS) else None
    except BaseException:  # noqa: BLE001 - that is what None reports
        return None


def see_severity(severity: object) -> None:
    """See that there is such a severity.

    Raises:
        ValueError: there is none.
    """
    if severity not in get_args(Severity):
        raise ValueError(f"there is no severity {severity!r:.60}; {choice('', get_args(Severity))}")


def see_names(what: str, named: object) -> None:
    """Check that the names of figures or units can be sent.

    Raises:
        ValueError: they are not.
    """
    if not isinstance(named, Mapping):
        raise ValueError(f"its {what} are {named!r:.60}; give them by name, as a dict")  # noqa: TRY004 - of the value
    if len(named) > MOST_FIGURES:
        raise ValueError(f"it has {len(named)} {what}; give {MOST_FIGURES} at most")
    for key in named:
        if not _is_line(key, MOST_CHARACTERS):
            raise ValueError(f"{key!r:.60} in its {what} is no name; {_wanted(MOST_CHARACTERS)}")


def see_texts(texts: Iterable[tuple[str, object]], longest: int = MOST_CHARACTERS) -> None:
    """See that texts can be sent, written down and shown in one line.

    Raises:
        ValueError: one cannot.
    """
    for name, text in texts:
        if not isinstance(text, str):
            raise ValueError(f"{name} is {text!r:.60}, which is not a text")  # noqa: TRY004 - of the value
        if not _is_line(text, longest):
            raise ValueError(f"{name} is {text!r:.60}; {_wanted(longest)}")


def see_numbers(figures: Iterable[tuple[str, Any]]) -> None:
    """See that figures are finite numbers.

    Raises:
        ValueError: one is not.
    """
    for name, value in figures:
        if not isinstance(value, Real):
            raise ValueError(f"{name} is {value!r:.60}, which is not a number")  # noqa: TRY004 - of the value
        if not _is_finite(value):
            raise ValueError(f"{name} is {value!s:.60}; give a finite number, or leave it out")


def see_statement(one: Diagnosis, earliest_ns: int, latest_ns: int) -> None:
    """Check that a statement that was made by hand can be sent, and is of its time.

    Args:
        one: the statement.
        earliest_ns: monotonic time before which nothing can be stated.
        latest_ns: monotonic time of the last sample of its window, or now if nothing has come.

    Raises:
        ValueError: it cannot, or is not.
    """
    see_severity(one.severity)
    if one.quality not in _QUALITIES:
        raise ValueError(f"there is no quality {one.quality!r:.60}; {choice('', _QUALITIES)}")
    names = ("machine", "detector", "stream", "decision", "where", "model")
    see_texts((name, getattr(one, name)) for name in names)
    see_texts([("reason", one.reason)], MOST_WORDS)
    for name in ("group", "sensors"):
        if not isinstance(listed := getattr(one, name), tuple | list):
            raise ValueError(f"{name} is {listed!r:.60}; give a tuple of names")  # noqa: TRY004 - of the value
        see_texts((name, text) for text in listed)
    _see_figures(one)
    for name in ("first_index", "end_index", "t_ns"):
        if not isinstance(value := getattr(one, name), Integral):
            raise ValueError(f"{name} is {value!r:.60}, which is not a whole number")  # noqa: TRY004 - of the value
    if not earliest_ns <= one.t_ns <= latest_ns + _AHEAD_NS:
        raise ValueError(
            f"t_ns is {one.t_ns!s:.60}; give the time of its last sample, from {earliest_ns} to {latest_ns}"
        )


def _see_figures(one: Diagnosis) -> None:
    for name in ("statistics", "units", "thresholds", "probabilities", "evidence", "bounds"):
        see_names(name, getattr(one, name))
    see_texts(one.units.items())
    for figures in (one.statistics, one.thresholds, one.probabilities, one.evidence):
        see_numbers(figures.items())
    for name, ends in one.bounds.items():
        if not isinstance(ends, tuple | list) or len(ends) != len(("low", "high")):
            raise ValueError(f"the bounds of {name} are {ends!r:.60}; give the lowest and the highest value")
        see_numbers((name, end) for end in ends)
    see_numbers((n, v) for n in ("revolutions", "missing_share") if (v := getattr(one, n)) is not None)


def _is_line(value: object, longest: int) -> bool:
    return isinstance(value, str) and len(value) <= longest and not _CONTROL.search(value)


def _wanted(longest: int) -> str:
    return f"give a text of {longest} characters at most, on one line, without NUL and surrogates"


def _is_finite(value: Any) -> bool:
    try:
        return math.isfinite(value)
    except OverflowError:  # an integer beyond what a float holds
        return False
