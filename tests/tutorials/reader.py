"""A reader who does what a tutorial says, word for word, and looks whether all is as shown.

A tutorial is Markdown. What the reader does is written in it like this:

- A block ``console``: lines that begin with ``$ `` are typed, the others are what is shown. A line ``...``
  stands for any lines, ``...`` within a line for any text. ``^C`` means that Ctrl-C is pressed. Where a
  program asks, what stands behind the prompt is typed.
- What only looks (``daqsvc status``, ``alarms``, ``trend``) is typed again until it shows what it must, as a
  person would: what it looks at takes its time.
- "In a second terminal" (or first, third, fourth) in the paragraph before a block says where it is typed.
  Without such words it is the same as before. A program that does not end goes on running there.
- "Save this as `NAME`" before a block: the reader writes that file.
- "Open `URL` in a browser" before a block: the page has the words of each line of it.
- "In `NAME`, replace" before a block, and "by" before the next one: the reader changes that file.
- "These lines of `NAME`" before a block: that file has them.

A block that is introduced in another way ends the reading with an error, unless `NOT_HERE` names it.

Ports that other programs may have taken are replaced by free ones, and ``/tmp`` by a folder of this
reader's own.
"""

from __future__ import annotations

import fcntl
import html
import os
import pty
import re
import select
import shlex
import signal
import struct
import subprocess
import sys
import termios
import time
import urllib.request
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from support.paths import ROOT
from support.ports import free_port

if TYPE_CHECKING:
    from pathlib import Path

PATIENCE_S = 60.0
"""So long a program may take to show what it must: only one that shows something else takes so long."""
ANY = "..."
CTRL_C = "^C"
PORTS = ("1883", "1884", "5020", "8420")
SHARED_TMP = "/tmp/"  # noqa: S108 - it is what is replaced
_FENCE = re.compile(r"^```(\w*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
_TERMINAL = re.compile(r"\b[Ii]n (?:a|the) (first|second|third|fourth) terminal")
_SAVE = re.compile(r"[Ss]ave this as `([^`]+)`")
_REPLACE = re.compile(r"[Ii]n `([^`]+)`, replace")
_HAS = re.compile(r"[Tt]hese lines of `([^`]+)`")
_OPEN = re.compile(r"[Oo]pen `http://([^`]+)` in a browser")
_COLUMNS = 100
_LOOK = re.compile(r"daqsvc (status|alarms|trend)\b(?!.*--watch)")


NOT_HERE = {
    (
        "05-can.md",
        "ip link set can0 up type can bitrate 500000\n",
    ): "needs a CAN controller: tests/hil/test_vcan_shown.py::test_the_bit_rate_of_the_tutorial_is_set",
    (
        "08-broker-and-home-assistant.md",
        '[mqtt]\nurl = "mqtts://broker.example:8883"\n',
    ): "needs the broker of a plant: tests/tutorials/test_tutorials.py::test_a_part_of_a_machine_file_fits",
}
"""Blocks that the reader passes over, by page and begin: why, and the test that runs or reads them."""


class NotAsShownError(AssertionError):
    """Something else came than the tutorial shows."""


class UnreadBlockError(AssertionError):
    """The reader does not know what to do with a block."""


@dataclass
class Step:
    """A block of the tutorial, and the paragraph before it.

    Attributes:
        words: the paragraph.
        language: of the block.
        text: what is in it.
        line: where it begins, from 1.
    """

    words: str
    language: str
    text: str
    line: int


def steps(markdown: str) -> list[Step]:
    """The blocks of a tutorial, in order.

    Raises:
        UnreadBlockError: a fence does not begin its line, or is of another kind.
    """
    found, end = [], 0
    for match in _FENCE.finditer(markdown):
        between = markdown[end : match.start()].strip()
        line = markdown.count("\n", 0, match.start()) + 1
        found.append(Step(between.split("\n\n")[-1].replace("\n", " "), match[1], match[2], line))
        end = match.end()
    outside = re.compile(r"^[ \t>]*(?:```|~~~)", re.MULTILINE)
    blank = _FENCE.sub(lambda match: "\n" * match[0].count("\n"), markdown)
    if (other := outside.search(blank)) is not None:
        line = blank.count("\n", 0, other.start()) + 1
        raise UnreadBlockError(f"line {line}: the reader does not read this fence: {other[0]!r}")
    return found


def is_introduced(step: Step) -> bool:
    """Whether the paragraph before a block states what a reader does with it."""
    found = any(known.search(step.words) for known in (_SAVE, _REPLACE, _HAS, _OPEN))
    return found or step.words.strip(" :") == "by"


def is_passed_over(page: str, step: Step) -> bool:
    """Whether a block of a page is one of `NOT_HERE`."""
    return any(page == where and step.text.startswith(begin) for where, begin in NOT_HERE)


@dataclass
class Terminal:
    """One terminal: a program at a time."""

    folder: Path
    environment: dict[str, str]
    process: subprocess.Popen[bytes] | None = None
    leader: int = -1
    pending: str = ""
    whole: bool = True
    seen: list[str] = field(default_factory=list)

    def start(self, command: str) -> None:
        """Type a command, when the one before has ended."""
        self.finish()
        self.leader, follower = pty.openpty()
        fcntl.ioctl(follower, termios.TIOCSWINSZ, struct.pack("HHHH", 50, _COLUMNS, 0, 0))
        self.process = subprocess.Popen(
            ["bash", "-c", f"exec {command}" if not re.search(r"[;&|<>]", command) else command],
            cwd=self.folder,
            env=self.environment,
            stdin=follower,
            stdout=follower,
            stderr=follower,
            start_new_session=True,
        )
        os.close(follower)
        self.pending, self.whole, self.seen = "", True, [f"$ {command}"]

    def show(self, shown: list[str]) -> None:
        """Wait for all that is shown, and type what is asked for."""
        # What went on meanwhile may have shown more, where the block before has said so.
        skipping = not self.whole
        self.whole = not (shown and shown[-1] in {ANY, CTRL_C})
        for expected in shown:
            if expected == ANY:
                skipping = True
            elif expected == CTRL_C:
                self.interrupt()
                skipping = True
            else:
                self._expect(expected, skipping=skipping)
                skipping = False

    def interrupt(self) -> None:
        """Press Ctrl-C."""
        assert self.process is not None
        os.killpg(self.process.pid, signal.SIGINT)

    def finish(self) -> None:
        """Wait until the program has ended, having shown nothing more."""
        if self.process is None:
            return
        rest = []
        while (line := self._line(None)) is not None:
            rest.append(line)
        self.process.wait(timeout=PATIENCE_S)
        self.process = None
        os.close(self.leader)
        if self.whole and any(line.strip() for line in rest):
            self._fail("nothing more", rest)

    def _expect(self, expected: str, *, skipping: bool) -> None:
        pattern = re.compile(".*".join(map(re.escape, expected.rstrip().split(ANY))))
        passed: list[str] = []
        while True:
            line = self._line(expected)
            if line is None:
                self._fail(expected, passed)
            elif pattern.fullmatch(line.rstrip()):
                return
            elif not skipping and line.strip():
                self._fail(expected, [line])
            passed.append(line or "")

    def _line(self, expected: str | None) -> str | None:
        """The next line, None at the end; at a prompt, what is typed there is in the line that is shown."""
        until = time.monotonic() + PATIENCE_S
        while "\n" not in self.pending:
            if time.monotonic() > until:
                self._fail(expected or "the end of the program", [self.pending])
            if select.select([self.leader], [], [], 0.2)[0]:
                try:
                    part = os.read(self.leader, 65_536)
                except OSError:  # the other end is closed
                    part = b""
                if not part:
                    line, self.pending = self.pending, ""
                    return line or None
                self.pending += part.decode("utf-8", "replace").replace("\r\n", "\n")
            elif expected is not None and self.pending.endswith(": "):
                prompt = self.pending
                if not expected.startswith(prompt.rstrip()):
                    self._fail(expected, [prompt])
                typed = expected[len(prompt) :] if len(expected) > len(prompt) else ""
                os.write(self.leader, f"{typed}\n".encode())
        line, _, self.pending = self.pending.partition("\n")
        self.seen.append(line)
        return line

    def _fail(self, expected: str, found: list[str]) -> None:
        before = "\n".join(self.seen[-60:])
        raise NotAsShownError(
            f"shown is {expected!r}, and there came {found[-3:]!r}; all that was there:\n{before}"
        )


def _look_until(terminal: Terminal, command: str, shown: list[str]) -> None:
    """Type it again until it shows what it must."""
    until = time.monotonic() + PATIENCE_S
    while True:
        terminal.start(command)
        try:
            terminal.show(shown)
            terminal.finish()
        except NotAsShownError:
            if time.monotonic() > until:
                raise
            terminal.whole = False
            terminal.finish()
            time.sleep(0.5)
        else:
            return


class Reader:
    """Follows a tutorial in a fresh folder.

    Args:
        folder: an empty one; a short path, as sockets lie in it.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder / "here"
        programs = folder / "bin"
        for one in (self.folder, programs, folder / "home", folder / "tmp"):
            one.mkdir()
        for name, arguments in (("daqsvc", "-m daqsvc "), ("python3", "")):
            program = programs / name
            program.write_text(
                f'#!/bin/sh\nexec {shlex.quote(sys.executable)} {arguments}"$@"\n', encoding="utf-8"
            )
            program.chmod(0o755)
        self._environment = {
            **{key: value for key, value in os.environ.items() if not key.startswith(("XDG_", "STATE_"))},
            "PATH": f"{programs}:{os.environ['PATH']}:/usr/sbin",
            "PYTHONPATH": f"{ROOT}",
            "HOME": f"{folder / 'home'}",
            "TMPDIR": f"{folder / 'tmp'}",
            "TERM": "dumb",
            "USER": "ann",
        }
        self._ports = {port: f"{free_port()}" for port in PORTS}
        self._own_tmp = f"{folder / 'tmp'}/"
        self._terminals: dict[str, Terminal] = {}
        self._at = "first"
        self._replaced: tuple[Path, str] | None = None
        self._page = ""

    def follow(self, markdown: str, page: str = "text") -> None:
        """Do all that a tutorial says.

        Args:
            markdown: its text.
            page: its name, for messages.

        Raises:
            NotAsShownError: something else came than it shows.
            UnreadBlockError: it has a block that the reader does not know what to do with.
        """
        self._page = page
        for port, free in self._ports.items():
            markdown = re.sub(rf"\b{port}\b", free, markdown)
        markdown = markdown.replace(SHARED_TMP, self._own_tmp)
        for step in steps(markdown):
            if step.language == "console":
                self._type(step)
            elif (address := _OPEN.search(step.words)) is not None:
                self._look(address[1], step.text)
            elif not is_passed_over(page, step):
                self._write(step)
        if self._replaced is not None:
            raise UnreadBlockError(f"{page}: no block follows with what is put in {self._replaced[0].name}")
        for terminal in self._terminals.values():
            terminal.finish()

    def close(self) -> None:
        """End what is still running."""
        for terminal in self._terminals.values():
            if terminal.process is not None:
                os.killpg(terminal.process.pid, signal.SIGKILL)
                terminal.process.wait()
                os.close(terminal.leader)

    def _type(self, step: Step) -> None:
        where = _TERMINAL.findall(step.words)
        name = self._at = where[-1] if where else self._at
        if name not in self._terminals:
            self._terminals[name] = Terminal(self.folder, self._environment)
        terminal = self._terminals[name]
        goes_on, *typed = re.split(r"^\$ ", step.text, flags=re.MULTILINE)
        if shown := list(filter(str.strip, goes_on.splitlines())):
            terminal.show(shown)
        for text in typed:
            command, *shown = filter(str.strip, text.splitlines())
            if _LOOK.match(command):
                _look_until(terminal, command, shown)
            else:
                terminal.start(command)
                terminal.show(shown)

    def _look(self, address: str, words: str) -> None:
        with urllib.request.urlopen(f"http://{address}", timeout=PATIENCE_S) as answer:
            page = html.unescape(re.sub(r"<[^>]*>", " ", answer.read().decode()))
        for line in filter(None, words.splitlines()):
            if line not in page:
                raise NotAsShownError(f"{address} does not show {line!r}:\n{page}")

    def _write(self, step: Step) -> None:
        if self._replaced is not None and step.words.strip(" :") != "by":
            raise UnreadBlockError(f'{self._page}:{step.line}: "by" and a block have to follow "replace"')
        if (save := _SAVE.search(step.words)) is not None:
            (self.folder / save[1]).write_text(step.text, encoding="utf-8")
        elif (replace := _REPLACE.search(step.words)) is not None:
            self._replaced = (self.folder / replace[1], step.text)
        elif (has := _HAS.search(step.words)) is not None:
            self._found_once(self.folder / has[1], step.text)
        elif self._replaced is not None:
            file, old = self._replaced
            file.write_text(self._found_once(file, old).replace(old, step.text), encoding="utf-8")
            self._replaced = None
        else:
            where, after = f"{self._page}:{step.line}", step.words[-80:]
            raise UnreadBlockError(f"{where}: nothing says what to do with this block, after {after!r}")

    @staticmethod
    def _found_once(file: Path, part: str) -> str:
        text = file.read_text(encoding="utf-8")
        if text.count(part) != 1:
            raise NotAsShownError(f"{file.name} has {text.count(part)} times:\n{part}")
        return text
