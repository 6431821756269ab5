"""Words about a plugin that fails: for its author, and for whoever has to do without it."""

from __future__ import annotations

import sys
from inspect import getattr_static, unwrap
from pathlib import Path
from traceback import walk_tb
from typing import TYPE_CHECKING, Any, NamedTuple

if TYPE_CHECKING:
    from collections.abc import Hashable
    from types import CodeType, FrameType

packages: dict[str, str] = {}
"""By the top-level module of a plugin, the distribution that brings it, with its version."""

_OURS = frozenset({"daqsvc", "drivers", "sim_hw"})
_ROOT = Path(__file__).parents[2]


class BrokenContractError(TypeError):
    """Code of a plugin has not raised, but done something else than its contract states.

    Args:
        hook: the function, method or property; None for the one that was asked.
        words: what it has done.
    """

    def __init__(self, hook: object, words: str) -> None:
        super().__init__(words)
        self.hook = hook


class ExitRaisedError(Exception):
    """A part of the service has raised SystemExit, which is not for a part to decide."""


class Failure(NamedTuple):
    """What code of a plugin has failed at.

    Attributes:
        message: that, in words for its author, with the line of the plugin's file.
        remedy: who can put it right.
        cause: alike for failures of one kind in one place, whatever the words.
    """

    message: str
    remedy: str
    cause: Hashable

    def or_remove(self, table: str) -> str:
        """The remedy, and how to do without the plugin.

        Args:
            table: what to remove, as people write it; empty if that is not known.
        """
        return f"{self.remedy}, or remove [{table}]" if table else self.remedy

    def __str__(self) -> str:
        return f"{self.message}; {self.remedy}"


def failure(error: BaseException, kind: type[Any], part: str) -> Failure:
    """What a hook of a plugin has failed at. If that asked a plugin from outside, it is this one's failure.

    Args:
        error: as it was caught.
        kind: class of the plugin, or of one of its tables.
        part: what of it was asked.
    """
    foreign = foreign_failure(error)
    if foreign is not None and not _is_foreign(kind.__module__):
        return foreign
    code = _code(getattr(error, "hook", None) or getattr_static(kind, part, None))
    homes = {getattr(sys.modules.get(kind.__module__), "__file__", None), code and code.co_filename}
    places = [(frame.f_code.co_filename, line) for frame, line in walk_tb(error.__traceback__)]
    own = [place for place in places if place[0] in homes]
    place = (own or places)[-1] if own or code is None else (code.co_filename, code.co_firstlineno)
    return _failure(error, f"{part} of {kind.__module__}.{kind.__qualname__}", place, kind.__module__)


def foreign_failure(error: BaseException) -> Failure | None:
    """What code of a plugin from outside has failed at; None if there is none in it."""
    if isinstance(error, BrokenContractError):
        hook = getattr(error.hook, "func", error.hook)
        code, home = _code(hook), getattr(hook, "__module__", "")
        if code is None or not _is_foreign(home):
            return None
        return _failure(error, _part(code, home), (code.co_filename, code.co_firstlineno), home)
    frames = _foreign_frames(error)
    if not frames:
        return None
    (first, _), (last, line) = frames[0], frames[-1]
    module = str(first.f_globals["__name__"])
    return _failure(error, _part(first.f_code, module), (last.f_code.co_filename, line), module)


def import_failure(error: BaseException, module: str) -> Failure:
    """Why a plugin cannot be loaded: it is not there, something that it imports is not, or it fails itself.

    Args:
        error: as it was caught.
        module: that its entry point names.
    """
    again = "install the package that brings it again"
    message = one_line(message_of(error))
    missing = error.name if isinstance(error, ModuleNotFoundError) else None
    if missing is not None and f"{module}.".startswith(f"{missing}."):
        return Failure(message, again, message)
    mend = authors_of(module)
    places = [(frame.f_code.co_filename, line) for frame, line in _foreign_frames(error)]
    if isinstance(error, SyntaxError) and error.filename:
        message, places = error.msg, [(error.filename, error.lineno or 0)]
    if not places:
        return Failure(message, mend, message)
    file, line = places[-1]
    remedy = mend if missing is None else f"install {missing}, or {mend}"
    return Failure(f"{type(error).__name__}: {message} ({Path(file).name}, line {line})", remedy, message)


def cause_of(error: BaseException) -> Hashable:
    """Alike for errors that are logged once: of outside plugins by kind and place, else by the words."""
    foreign = foreign_failure(error)
    return in_words(error) if foreign is None else foreign.cause


def in_words(error: BaseException) -> str:
    """An exception in one line, with the plugin that it came from, or the line of this program."""
    foreign = foreign_failure(error)
    if foreign is not None:
        return str(foreign)
    first_line = one_line(next(iter(message_of(error).splitlines()), ""))
    if isinstance(error, BrokenContractError):
        return first_line
    kind = type(error).__name__
    what = f"{kind}: {first_line}" if first_line else kind
    place = ""
    for frame, line in walk_tb(error.__traceback__):
        path = Path(frame.f_code.co_filename)
        if path.is_relative_to(_ROOT) and path.name != "supervision.py":
            place = f" at {path.relative_to(_ROOT)}:{line}"
    return f"failed with {what}{place}"


def message_of(error: BaseException) -> str:
    """What an error states; empty if that fails, too."""
    try:
        return f"{error}"
    except Exception:  # noqa: BLE001 - the words of an error must not be another one
        return ""


def one_line(text: str) -> str:
    """A text of somebody else on one line, without what would change the state of a terminal."""
    if text.isprintable():
        return text
    return "".join(
        letter if letter.isprintable() else "\N{REPLACEMENT CHARACTER}" for letter in " ".join(text.split())
    )


def error_text(error: BaseException) -> str:
    """The kind of an error and what it reports, on one line."""
    message = one_line(message_of(error))
    name = "" if isinstance(error, BrokenContractError | ExitRaisedError) else type(error).__name__
    return ": ".join(word for word in (name, message) if word)


def authors_of(module: str) -> str:
    """Who can put right a plugin that fails.

    Args:
        module: of the plugin, or of one of its tables.
    """
    home = module.partition(".")[0]
    return f"have the authors of {packages.get(home, f'the package of {home}')} fix it"


def _failure(error: BaseException, part: str, place: tuple[str, int], module: str) -> Failure:
    where = f"{Path(place[0]).name}, line {place[1]}"
    cause = (type(error).__name__, part, where)
    return Failure(f"{part} has failed: {error_text(error)} ({where})", authors_of(module), cause)


def _part(code: CodeType, module: str) -> str:
    """A function as people write it, e.g. ``judge of crest.CrestDetector``."""
    home, _, name = code.co_qualname.partition(".<locals>")[0].rpartition(".")
    return f"{name} of {module}{home and f'.{home}'}"


def _code(hook: object) -> CodeType | None:
    """Where a method, function or property was written; None if it is none of these."""
    hook = getattr(hook, "fget", getattr(hook, "__func__", hook))
    return getattr(unwrap(hook), "__code__", None) if callable(hook) else None


def _foreign_frames(error: BaseException) -> list[tuple[FrameType, int]]:
    """What the error came through in plugins from outside, with the line of each."""
    trace = walk_tb(error.__traceback__)
    return [(frame, line) for frame, line in trace if _is_foreign(frame.f_globals.get("__name__", ""))]


def is_ours(module: str) -> bool:
    """Whether a module is of this program, not of a plugin from outside."""
    return module.partition(".")[0] in _OURS


def _is_foreign(module: str) -> bool:
    home = module.partition(".")[0]
    return home in packages and home not in _OURS
