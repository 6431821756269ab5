"""``daqsvc new``: asks a few questions, and writes a first machine file that can be used."""

from __future__ import annotations

import os
import shlex
import sys
import tempfile
import tomllib
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from daqsvc.commands.arguments import EXIT_FAILED, EXIT_OK, EXIT_USAGE
from daqsvc.commands.complaint import complain
from daqsvc.commands.new.buses import bus_of
from daqsvc.commands.new.topics import all_topics
from daqsvc.commands.plugged import foreign_words
from daqsvc.documentation import documented_in
from daqsvc.errors.command_line import CANNOT_WRITE, INTERRUPTED
from daqsvc.errors.machine_file import PLUGIN_FAILED
from drivers.questions import SENSOR, short_name
from drivers.sniffing import NothingFoundError, SniffError

if TYPE_CHECKING:
    import argparse
    from collections.abc import Callable, Iterator, Mapping

    from daqsvc.commands.new.interview import AnswerError
    from drivers.bus_questions import BusQuestions, Heard
    from drivers.questions import Answers, Question


_HOW_TO_ANSWER = "Enter takes what is in brackets, ? explains, < goes back, Ctrl-C ends and writes nothing.\n"


class NewCommand:
    """``daqsvc new [FILE]``."""

    help = "write a first machine file: asks a few questions"
    description = (
        "Ask a few questions about a machine and write a machine file, with comments, that daqsvc check "
        "accepts. Enter takes the default, ? explains a question, < goes back, Ctrl-C ends and writes "
        "nothing. Every answer is an option as well: with all of them, or with --yes, nothing is asked."
    )

    def add_arguments(self, parser: argparse.ArgumentParser) -> None:
        """See `daqsvc.cli.Command.add_arguments`."""
        parser.add_argument(
            "file",
            type=Path,
            nargs="?",
            metavar="FILE",
            help="machine file to write (default: the machine's name with .toml)",
        )
        parser.add_argument(
            "--listen",
            action="store_true",
            help="listen to the bus as soon as its port or address is known, and propose what is found there",
        )
        parser.add_argument(
            "--yes",
            action="store_true",
            help="ask nothing: take the default of each question that has no answer",
        )
        parser.add_argument("--overwrite", action="store_true", help="replace the file if it exists")
        parser.add_argument(
            "--answers", type=Path, metavar="TOML", help="file with answers: its keys are the options below"
        )
        group = parser.add_argument_group("answers")
        group.add_argument(
            f"--{SENSOR}",
            action="append",
            default=[],
            metavar="CHANNEL.TOPIC=ANSWER",
            help="answer for one channel, e.g. x.type=accelerometer; TOPIC is type, name, unit, sensitivity, "
            "angle, threshold or bearing, with Modbus values also address, register-type, order, scale or "
            "no-value",
        )
        for key, topic in all_topics().items():
            question = topic.text if topic.text.endswith("?") else f"{topic.text}."
            words = f"{question} {topic.help}".replace("%", "%%")
            group.add_argument(f"--{key}", dest=f"answer {key}", metavar="ANSWER", help=words)

    def run(self, arguments: argparse.Namespace) -> int:
        """See `daqsvc.cli.Command.run`."""
        from daqsvc.commands.new.interview import AnswerError, Given, conduct  # noqa: PLC0415 - slow to import
        from daqsvc.commands.new.machine_text import machine_text  # noqa: PLC0415

        person = sys.stdin.isatty() and sys.stdout.isatty()
        ask = _ask if person and not arguments.yes else None
        target = _Target(arguments.file, ask, overwrite=arguments.overwrite)
        try:
            beforehand = Given(_answers_beforehand(arguments), arguments.yes)
            target.see()
            if ask is not None:
                _say(_HOW_TO_ANSWER)
            listen = partial(_heard, target.folder, person=ask is not None) if arguments.listen else None
            answers = conduct(
                target.file, beforehand, ask, lambda reason: _say(f"  {reason}"), listen, target.named
            )
            text = machine_text(answers, shlex.quote(target.file.name))
            _write(target.file, text)
        except (AnswerError, SniffError) as error:
            return _refused(error)
        except KeyboardInterrupt:
            return complain("daqsvc new", "interrupted; nothing was written", INTERRUPTED)
        except EOFError:
            return complain("daqsvc new", "the input has ended; nothing was written", INTERRUPTED)
        except OSError as error:
            what = f"{error.filename} cannot be written: {error.strerror}"
            return complain("daqsvc new", what, CANNOT_WRITE)
        except Exception as error:
            if (words := foreign_words(error)) is None:
                raise
            return complain("daqsvc new", f"nothing was written: {words}", PLUGIN_FAILED)
        return _report(target.file, text, answers)


class _Target:
    """The file that will be written: that of the command line, or one that is called like the machine.

    A file that is there already is asked about as soon as its name is known, not behind all questions.
    """

    def __init__(self, file: Path | None, ask: Callable[[Question], str] | None, *, overwrite: bool) -> None:
        self._file_named = file
        self.file = file or Path("machine.toml")
        self._overwrite = overwrite
        self._person = ask is not None

    @property
    def folder(self) -> Path:
        """Where it will lie."""
        return self.file.parent

    def see(self) -> None:
        """Say before all questions that the file of the command line cannot be written.

        Raises:
            AnswerError: it cannot, or it is there already and nobody can be asked.
        """
        from daqsvc.commands.new.interview import AnswerError  # noqa: PLC0415 - slow to import

        if self._file_named is None:
            return
        if self._file_named.is_dir():
            raise AnswerError(
                f"{self._file_named} is a directory; name a file in it, e.g. {self._file_named / 'pump.toml'}"
            )
        if not self.folder.is_dir():
            raise AnswerError(f"there is no directory {self.folder}; make it first: mkdir -p {self.folder}")
        self.file = self._free(self._file_named)

    def named(self, question: Question, answers: Answers) -> None:
        """Take the name of the machine for the file, where the command line names none.

        Raises:
            AnswerError: that file is there already, and nobody can be asked.
        """
        if question.key != "name":
            return
        short = short_name(answers["name"])
        if self._person and short != answers["name"]:
            _say(f'  It is called "{short}" in topics and names of files.')
        if self._file_named is None:
            self.file = self._free(Path(f"{short}.toml"))

    def _free(self, file: Path) -> Path:
        """The file, or another one where it is there already and must stay."""
        from daqsvc.commands.new.interview import AnswerError  # noqa: PLC0415 - slow to import

        if self._overwrite:
            return file
        if file.exists() and not self._person:
            raise AnswerError(f"{file} is there already; give another FILE, or --overwrite")
        while file.exists():
            text = input(f"{file} is there already. Another name, or overwrite: ").strip()
            if text == "overwrite":
                break
            if text:
                file = file.with_name(text) if "/" not in text else Path(text)
        return file


def _answers_beforehand(arguments: argparse.Namespace) -> dict[str, str]:
    """The answers of the command line and of the file of answers, by key; the command line wins."""
    from daqsvc.commands.new.interview import AnswerError  # noqa: PLC0415 - slow to import

    answers = {} if arguments.answers is None else _of_file(arguments.answers)
    for key in all_topics():
        answer = getattr(arguments, f"answer {key}")
        if answer is not None:
            answers[key] = answer
    for text in arguments.sensor:
        key, equals, answer = text.partition("=")
        if not equals or "." not in key:
            raise AnswerError(f"--{SENSOR} {text}: write CHANNEL.TOPIC=ANSWER, e.g. x.type=accelerometer")
        answers[f"{SENSOR}.{key}"] = answer
    return answers


def _of_file(path: Path) -> dict[str, str]:
    from daqsvc.commands.new.interview import AnswerError  # noqa: PLC0415 - slow to import

    try:
        document = tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise AnswerError(f"--answers {path}: {error.strerror}") from None
    except ValueError as error:  # of TOML, or of UTF-8
        raise AnswerError(f"--answers {path} is no TOML: {error}") from None
    answers, known = dict(_flat(document)), all_topics()
    for key in answers:
        if key not in known and not key.startswith(f"{SENSOR}."):
            from daqsvc.settings.problems import choice  # noqa: PLC0415 - slow to import

            raise AnswerError(f"--answers {path}: there is no question {key!r}; {choice(key, known)}")
    return answers


def _flat(table: Mapping[str, Any], before: str = "") -> Iterator[tuple[str, str]]:
    """The answers of a table and those within it, as they would be typed."""
    for key, value in table.items():
        if isinstance(value, dict):
            yield from _flat(value, f"{before}{key}.")
        else:
            yield f"{before}{key}", _typed(value)


def _typed(value: Any) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    return ", ".join(map(_typed, value)) if isinstance(value, list) else f"{value}"


def _ask(question: Question) -> str:
    """What a person types, and nothing for the default; ``?`` is answered with help.

    Raises:
        BackError: ``<`` was typed.
    """
    from daqsvc.commands.new.interview import BackError  # noqa: PLC0415 - slow to import

    beside = f", {question.beside}" if question.beside else ""
    bracket = "" if question.default is None else f" [{question.default}{beside}]"
    _say(question.topic.text)
    width = max(map(len, question.choices or [""]))
    for choice, about in (question.choices or {}).items():
        if about:
            _say(f"    {choice:<{width}}  {about}")
    words = [choice for choice, about in (question.choices or {}).items() if not about]
    options = f" {', '.join(words)}" if words else ""
    while True:
        text = input(f" {options}{bracket}: ").strip()
        if text == "?":
            _say(f"  {question.topic.help}")
        elif text == "<":
            raise BackError
        elif text or question.default is not None:
            return text
        else:
            _say("  there is no default: type an answer, or ? for help")


def _heard(folder: Path, bus: BusQuestions, answers: Answers, *, person: bool) -> Heard | SniffError:
    """What is on the bus, which is shown to the person, too; or why nothing was found.

    Raises:
        SniffError: nothing was found, and nobody is there who could correct an answer.
    """
    from daqsvc.commands.stopping import stopping  # noqa: PLC0415 - only for who listens

    try:
        with stopping() as stop:
            heard = bus.listen(answers, folder, stop, lambda line: _say(f"  {line}"))
    except SniffError as error:
        if not person:
            raise
        is_deaf = not isinstance(error, NothingFoundError)
        _say(f"  {'The bus could not be listened to' if is_deaf else 'Nothing was found'}: {error}")
        return error
    _say("  Found:" if heard.missed else "  Found, and proposed below:")
    for line in heard.lines:
        _say(f"    {line}")
    return heard


def _refused(error: AnswerError | SniffError) -> int:
    """Say why nothing is written: an answer cannot be used, or the bus does not have what it states."""
    if isinstance(error, SniffError):
        exit_code = EXIT_USAGE if error.usage else EXIT_FAILED
        return complain("daqsvc new", f"nothing was written: {error}", error.code, exit_code)
    return complain("daqsvc new", error, error.code, EXIT_USAGE)


def _write(file: Path, text: str) -> None:
    """Write a file as a whole, or not at all."""
    with tempfile.NamedTemporaryFile("w", encoding="utf-8", dir=file.parent, prefix=".", delete=False) as out:
        try:
            out.write(text)
            out.flush()
            mask = os.umask(0)
            os.umask(mask)
            Path(out.name).chmod(0o666 & ~mask)
            Path(out.name).replace(file)
        except BaseException:
            Path(out.name).unlink(missing_ok=True)
            raise


def _report(file: Path, text: str, answers: Answers) -> int:
    """Say what was written, and what to type next."""
    from daqsvc.box import Box  # noqa: PLC0415 - slow to import
    from daqsvc.commands.new.interview import checked  # noqa: PLC0415
    from daqsvc.commands.new.machine_text import NOTES  # noqa: PLC0415
    from daqsvc.commands.store_argument import doubts_of_owner  # noqa: PLC0415

    machine = checked(text, file)
    quoted = shlex.quote(f"{file}")
    _say(f"\n{file} is written; daqsvc check finds no error in it.")
    for note in answers.get(NOTES, ()):
        _say(note)
    for warning in (*machine.warnings, *doubts_of_owner(Box.single(machine))):
        _say(f"{warning}")
    if not machine.alarms:
        _say(
            "No alarm is in it yet: write a table [[alarms]] in place of its comment on alarms, see "
            f"{documented_in('alarms')}; or run daqsvc new again with --limits."
        )
    beside, about = bus_of(answers).beside(quoted)
    commands = {
        f"daqsvc check {quoted}": "what was understood",
        f"daqsvc run {quoted}": "watches the machine, until Ctrl-C",
        beside: about,
    }
    width = max(map(len, commands))
    _say("\nNext:")
    for command, what in commands.items():
        _say(f"  {command:<{width}}    {what}")
    return EXIT_OK


def _say(text: str) -> None:
    print(text)  # noqa: T201 - this is what the verb is for
