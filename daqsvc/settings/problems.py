"""What is wrong with a machine file, reported so that it can be corrected at once."""

from __future__ import annotations

from dataclasses import dataclass
from difflib import get_close_matches
from itertools import islice
from typing import TYPE_CHECKING, TypeAlias

from daqsvc.errors.code import with_code
from daqsvc.errors.machine_file import NAMED_TWICE, OF_A_PLUGIN

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence
    from pathlib import Path

    from daqsvc.errors.code import Code

KeyPath: TypeAlias = tuple[str | int, ...]
"""A place in the file: keys, and 0-based positions in arrays, e.g. ``("sensors", 0, "name")``."""


_MOST_LISTED = 30
_MOST_COMPARED = 300


@dataclass(frozen=True, slots=True)
class Finding:
    """Something wrong with values that are valid each for itself.

    Attributes:
        path: where to look first.
        message: what is wrong, to be read after the value.
        remedy: what to do about it.
        fatal: False for a warning.
        code: of the kind of mistake; one for all messages of plugins that have none of their own.
    """

    path: KeyPath
    message: str
    remedy: str
    fatal: bool = True
    code: Code | None = OF_A_PLUGIN


@dataclass(frozen=True, slots=True)
class Problem:
    """One thing wrong with a machine file.

    Attributes:
        file: the machine file.
        line: line of the key, from 1; None if it concerns the file as a whole.
        key: dotted key, e.g. ``sensors[0].name``; empty if it concerns the file as a whole.
        value: the value as the file has it; empty if there is none, secrets masked.
        message: what is wrong with it.
        remedy: what to do about it.
        code: see `Finding`.
        name: of the sensor, alarm or the like whose whole table ``key`` is; empty otherwise.
    """

    file: Path
    line: int | None
    key: str
    value: str
    message: str
    remedy: str
    code: Code | None = None
    name: str = ""

    @property
    def subject(self) -> str:
        """The key with its value or, of a table, its name; empty if it concerns the file as a whole."""
        if self.value:
            return f"{self.key} = {self.value}"
        return f'{self.key} ("{self.name}")' if self.name else self.key

    def __str__(self) -> str:
        place = f"{self.file}:{self.line}" if self.line is not None else f"{self.file}"
        middle = f"{self.subject}: " if self.subject else ""
        return with_code(f"{place}: {middle}{self.message}. Remedy: {self.remedy}", self.code)


class MachineFileError(Exception):
    """A machine file that cannot be used, with every problem found in it.

    Attributes:
        problems: all of them, in the order of the file; never empty.
    """

    def __init__(self, problems: Sequence[Problem]) -> None:
        super().__init__(problems)
        self.problems = tuple(problems)

    def __str__(self) -> str:
        return "\n\n".join(str(problem) for problem in self.problems)


class AssemblyError(Exception):
    """A machine file that is sound by itself asks for something that is not there, or cannot be made.

    Args:
        message: what is wrong, and what to do about it.
        code: of the kind of mistake; one for all errors of plugins that have none of their own.
    """

    def __init__(self, message: str, *, code: Code | None = None) -> None:
        super().__init__(message)
        self.code: Code | None = code or OF_A_PLUGIN

    def __str__(self) -> str:
        return with_code(super().__str__(), self.code)


def choice(wanted: str, known: Iterable[str]) -> str:
    """A remedy for a name that is not known: the closest one, or all there are."""
    names = sorted(known)
    if not names:
        return "there is none to choose from; define one first"
    close = get_close_matches(wanted, islice(names, _MOST_COMPARED), n=1)
    listed = ", ".join(names[:_MOST_LISTED]) + (", ..." if len(names) > _MOST_LISTED else "")
    return f'did you mean "{close[0]}"? There are: {listed}' if close else f"take one of: {listed}"


def unique(names: list[str], at: KeyPath, what: str) -> Iterator[Finding]:
    """Findings for every name that has been given before in the same array."""
    seen: dict[str, int] = {}
    for index, name in enumerate(names):
        if seen.setdefault(name, index) != index:
            yield Finding(
                (*at, index, "name"),
                f"is the name of an earlier {what} already",
                f"give each {what} its own name",
                code=NAMED_TWICE,
            )
