"""Verbs of the command line, called in this process in a folder of its own; and what they answered."""

from __future__ import annotations

import contextlib
import io
import os
import shutil
import tempfile
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING
from unittest import mock

from daqsvc.cli import main

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

ROOT = Path(__file__).parents[2]
SPECIMENS = Path(__file__).parent / "specimens"
WIDTH = "100"
"""Columns of the terminal that texts are wrapped for."""


@dataclass(frozen=True)
class Answer:
    """What a command line led to.

    As a text, lines of stderr begin with an exclamation mark.

    Attributes:
        arguments: of ``daqsvc``.
        code: the exit code.
        out: what was written to stdout.
        err: what was written to stderr.
    """

    arguments: tuple[str, ...]
    code: int | str
    out: str
    err: str

    def __str__(self) -> str:
        lines = [f"$ daqsvc {' '.join(map(_quoted, self.arguments))}", *self.out.splitlines()]
        lines += [f"! {line}".rstrip() for line in self.err.splitlines()]
        return "\n".join([*lines, f"exit code {self.code}"])


def _quoted(argument: str) -> str:
    return argument if argument and " " not in argument else repr(argument)


def answer(*arguments: str) -> Answer:
    """Call ``daqsvc`` with these arguments in the current folder; its path is taken out of the texts."""
    out, err = io.StringIO(), io.StringIO()
    code: int | str
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            code = main(arguments)
        except SystemExit as ended:
            code = str(ended.code) if ended.code is None else ended.code
    here = os.getcwd()  # noqa: PTH109 - as a text
    return Answer(arguments, code, *(text.getvalue().replace(here, "<here>") for text in (out, err)))


@contextlib.contextmanager
def _entry_points_read_once() -> Iterator[None]:
    """Spare each of a thousand calls the reading of what is installed, which does not change meanwhile."""
    there = list(metadata.distributions())
    points = {id(one): one.entry_points for one in there}
    with (
        mock.patch.object(metadata, "distributions", return_value=there),
        mock.patch.object(metadata.Distribution, "entry_points", property(lambda one: points[id(one)])),
    ):
        yield


@contextlib.contextmanager
def workplace() -> Iterator[Path]:
    """A folder with copies of the examples, the specimens and the DBC files, as the current folder.

    Its path has the same length everywhere, as texts that hold it are wrapped. What else a text could depend
    on is set: the width of the terminal, time zone, language, home, user, and where state is kept.
    """
    folder = Path(tempfile.mkdtemp(prefix="guard-", dir="/tmp"))
    surroundings = {
        "COLUMNS": WIDTH,
        "LINES": "40",
        "TZ": "UTC",
        "LC_ALL": "C.UTF-8",
        "NO_COLOR": "1",
        "HOME": str(folder / "home"),
        "LOGNAME": "guard",
        "USER": "guard",
        "XDG_STATE_HOME": str(folder / "state"),
    }
    before = dict(os.environ)
    shutil.copytree(ROOT / "config" / "machines", folder / "machines")
    shutil.copytree(ROOT / "config" / "devices", folder / "devices")
    shutil.copytree(SPECIMENS, folder / "machines", dirs_exist_ok=True)
    try:
        os.environ.update(surroundings)
        for name in ("STATE_DIRECTORY", "CREDENTIALS_DIRECTORY", "JOURNAL_STREAM"):
            os.environ.pop(name, None)
        with contextlib.chdir(folder), _entry_points_read_once():
            yield folder
    finally:
        os.environ.clear()
        os.environ.update(before)
        shutil.rmtree(folder)


def machine_files(folder: Path) -> Sequence[str]:
    """The machine files of a workplace, relative to it, in order."""
    return sorted(str(path.relative_to(folder)) for path in (folder / "machines").glob("*.toml"))
