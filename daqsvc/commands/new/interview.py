"""From questions to answers: each must give a file that ``daqsvc check`` accepts."""

from __future__ import annotations

import difflib
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from daqsvc.commands.new.assumed import ASSUMED
from daqsvc.commands.new.buses import bus_of, buses
from daqsvc.commands.new.machine_text import NOTES, assumed_words, machine_text, questions
from daqsvc.commands.new.sensors import CLASSES, limits_words, notes_on_velocity, why_no_bearing
from daqsvc.commands.new.topics import TOPICS
from daqsvc.errors.command_line import ANSWER
from drivers import questions as q
from drivers.bus_questions import BEFOREHAND, SHARED
from drivers.questions import SENSOR, Answers, Question
from drivers.sniffing import NothingFoundError, SniffError

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence
    from pathlib import Path

    from daqsvc.settings import MachineFile
    from drivers.bus_questions import BusQuestions, Heard


class AnswerError(Exception):
    """An answer that was given beforehand cannot be used, or is missing; states which option it is."""

    code = ANSWER


@dataclass(frozen=True, slots=True)
class Given:
    """What was answered beforehand.

    Attributes:
        texts: by the key of the question.
        defaults: whether the default is taken of all others.
    """

    texts: Mapping[str, str]
    defaults: bool


def conduct(
    file: Path,
    beforehand: Given,
    ask: Callable[[Question], str] | None,
    say: Callable[[str], None],
    listen: Callable[[BusQuestions, Answers], Heard | SniffError | None] | None = None,
    answered: Callable[[Question, Answers], None] | None = None,
) -> Answers:
    """All answers.

    Args:
        file: the machine file that will be written.
        beforehand: what was answered beforehand.
        ask: asks a person; None where there is none.
        say: tells that person why an answer is asked for again.
        listen: reads the bus as soon as it is known where it is, and returns what was heard, or why nothing
            was; None if that is not wanted.
        answered: called with each question after its answer; may raise `AnswerError`.

    Raises:
        AnswerError: what was given cannot be used, or something is missing.
        NothingFoundError: what was looked for was not heard, and nobody can be asked.
    """
    if listen is None:
        _refuse_for_listening(beforehand)
    interview = _Interview(file, beforehand, ask, say, listen, answered)
    while not interview.is_over():
        pass
    _refuse_others(beforehand, interview)
    answers = interview.answers | {ASSUMED: interview.assumed()}
    # What is assumed comes last: it lists keys, and the sentences before it are about what was heard.
    return answers | {NOTES: [*interview.notes(), *limits_words(answers), *assumed_words(answers)]}


class BackError(Exception):
    """A person wants to correct the answer before."""


class _Interview:
    """Questions and answers so far; see `conduct`."""

    def __init__(
        self,
        file: Path,
        beforehand: Given,
        ask: Callable[[Question], str] | None,
        say: Callable[[str], None],
        listen: Callable[[BusQuestions, Answers], Heard | SniffError | None] | None,
        answered: Callable[[Question, Answers], None] | None,
    ) -> None:
        self.answers: Answers = {}
        self.asked: list[str] = []
        self._file, self._beforehand = file, beforehand
        self._ask, self._say, self._listen, self._answered = ask, say, listen, answered
        self._typed: list[str] = []
        """Keys of what a person has answered, the last one last."""
        self._heard: Heard | None = None
        self._has_listened = False
        self._deaf: SniffError | None = None
        """Why nothing was heard."""
        self._taken: dict[str, bool] = {}
        """Keys of questions whose default was taken, by Enter or unasked, and whether it was heard."""
        self._unheard = ""

    def assumed(self) -> frozenset[str]:
        """Keys of answers that nobody has given and nothing has shown; none of a simulated machine."""
        bus = bus_of(self.answers)
        if bus.simulated:
            return frozenset()
        return frozenset(self._unheard_defaults - set(bus.stated(self.answers)))

    @property
    def _unheard_defaults(self) -> set[str]:
        """Keys of questions whose default was taken, and was not heard."""
        return {key for key, heard in self._taken.items() if not heard}

    def notes(self) -> list[str]:
        """What in the file was neither answered nor heard, and what was heard and is not in it."""
        not_read = () if self._heard is None else self._heard.not_read(self.answers)
        return [*self._not_heard(), *not_read, *notes_on_velocity(self.answers)]

    def _not_heard(self) -> Sequence[str]:
        """What in the file was neither answered nor heard, or is a guess by what was heard."""
        assumed = self._unheard_defaults
        example = bool(assumed & _OF_CHANNELS) or any(key.endswith(".address") for key in assumed)
        if not self._has_listened:
            example_only = bus_of(self.answers).example(self.answers, assumed)
            return [example_only] if example_only else []
        origin = bus_of(self.answers).origin(self.answers)
        if self._heard is None:
            if self._deaf is not None and not isinstance(self._deaf, NothingFoundError):
                # Whoever reads that nothing was heard looks for the fault at the device.
                so = f"; the channels are {origin}" * example
                return [f"The bus could not be listened to{so}: {self._deaf}"]
            return [f"Nothing was heard on the bus; the channels are {origin}."] * example
        if not self._heard.missed:
            return [*self._heard.notes(self.answers, assumed, self._taken.keys())]
        if example:
            unheard = f"None of these channels was heard on the bus; they are {origin}."
            return [unheard, f"{self._heard.missed}."]
        return [f"What was heard does not fit this file: {self._heard.missed}."] * bool(assumed & _COUNTERS)

    def is_over(self) -> bool:
        """Ask what is not answered yet; False if a person goes back, and the rest must be asked again."""
        self.asked = []
        try:
            for question in questions(self.answers, self._file.parent):
                self.asked.append(question.key)
                if question.key not in self.answers:
                    self._take(question)
        except BackError:
            self._go_back()
            return False
        return True

    def _take(self, plain: Question) -> None:
        question, is_entered = self._as_heard(plain), False
        is_heard = self._is_heard(question)
        key, texts = question.key, self._beforehand.texts
        key_beforehand = self._key_beforehand(key)
        if key_beforehand in texts:
            reason = take(question, texts[key_beforehand], self.answers, self._file)
            if reason is not None:
                refused = f"{given_as(key_beforehand, texts[key_beforehand])}: {reason}"
                if self._ask is None:
                    raise AnswerError(refused)
                # What a person has typed by now is not lost for that.
                self._say(refused)
                is_entered = _answer(question, self._ask, self._say, self.answers, self._file)
                self._typed.append(key)
        elif question.default is not None and (self._beforehand.defaults or self._is_quiet(question)):
            reason, is_entered = take(question, question.default, self.answers, self._file), True
            if reason is not None:
                raise AnswerError(f"{option(key)} must be given: {question.default} cannot be used: {reason}")
        elif self._ask is None:
            raise AnswerError(_missing(question))
        else:
            is_entered = _answer(question, self._ask, self._say, self.answers, self._file)
            self._typed.append(key)
        if is_entered and self._is_default(question):
            self._taken[key] = is_heard
        if self._answered is not None:
            self._answered(question, self.answers)
        self._see_unheard()
        self._see_unknown()
        self._behind(key)

    def _as_heard(self, plain: Question) -> Question:
        """The question with what was heard as its default."""
        if self._heard is None:
            return plain
        question = _offered(plain, self._heard, self.answers, self._file)
        self._see_rate(question, self._heard)
        return question

    def _is_heard(self, question: Question) -> bool:
        """Whether its default was heard, also where it is the usual one."""
        if question.quiet and question.key.startswith(f"{SENSOR}."):
            return True  # of what the channel has not, as the byte order of one register
        proposed = None if self._heard is None else self._heard.proposals(self.answers).get(question.key)
        return proposed is not None and proposed == question.default

    def _key_beforehand(self, key: str) -> str:
        """The key itself, or that of an answer given beforehand to which listening is narrowed."""
        if key == "bus" or key in self._beforehand.texts or self._listen is None or "bus" not in self.answers:
            return key
        return bus_of(self.answers).narrowed_by.get(key, key)

    def _is_default(self, question: Question) -> bool:
        default = question.default
        return default is not None and self.answers[question.key] == question.read(default)

    def _see_rate(self, question: Question, heard: Heard) -> None:
        """Say that the rate that was heard cannot be taken: no other one takes its place in silence.

        Raises:
            AnswerError: it cannot, and nobody can be asked.
        """
        rate = heard.proposals(self.answers).get(question.key) if question.key == "rate" else None
        if rate is None or question.key in self._beforehand.texts:
            return
        reason = take(question, rate, dict(self.answers), self._file)
        if reason is None:
            return
        message = f"{rate} samples a second were heard, which cannot be used: {reason}"
        if self._ask is None:
            raise AnswerError(f"{option(question.key)}: {message}")
        self._say(message)

    def _see_unheard(self) -> None:
        """Say that what the answers state was not heard.

        Raises:
            NothingFoundError: it was not, and nobody can be asked.
        """
        unheard = "" if self._heard is None else self._heard.unheard(self.answers)
        if unheard and self._ask is None:
            raise NothingFoundError(unheard)
        if unheard and unheard != self._unheard:
            self._say(unheard)
        self._unheard = unheard

    def _see_unknown(self) -> None:
        """Write nothing of what was neither heard nor answered: a machine must not be watched by it.

        Raises:
            NothingFoundError: there is such a thing, and nobody can be asked.
        """
        unknown = "" if self._heard is None else self._heard.unknown(self.answers, self._unheard_defaults)
        if unknown and self._ask is None:
            raise NothingFoundError(unknown)

    def _is_quiet(self, question: Question) -> bool:
        """Whether the default is taken; of what is looked for, unless a person listens."""
        if question.key != "bus" and question.key in bus_of(self.answers).for_listening:
            return self._listen is None or self._ask is None
        return question.quiet

    def _behind(self, key: str) -> None:
        """What follows the answer to a question."""
        if key == "bus":
            _refuse_of_other_buses(self._beforehand, self.answers)
        if self._listen is not None:
            self._listen_behind(key, self._listen)

    def _listen_behind(
        self, key: str, listen: Callable[[BusQuestions, Answers], Heard | SniffError | None]
    ) -> None:
        """Listen if the bus can be found by the answers up to this one."""
        bus = bus_of(self.answers)
        if key == "bus" and not bus.listens_behind:
            self._say("--listen is left out: on a bus of this kind there is nothing to listen to")
        if key == bus.listens_behind:
            heard = listen(bus, self.answers | {BEFOREHAND: self._beforehand.texts})
            self._deaf = heard if isinstance(heard, SniffError) else None
            self._heard = None if isinstance(heard, SniffError) else heard
            self._has_listened = True
            if self._heard is not None:
                # By these it was found: a wrong baud rate or parity would have shown nothing.
                self._taken |= dict.fromkeys(self._taken, True)
            if self._heard is not None and self._heard.missed:
                if self._ask is None:
                    raise NothingFoundError(self._heard.missed)
                self._say(self._heard.missed)
            if self._typed and (self._heard is None or self._heard.missed):
                self._say("< goes back to correct an answer; then it listens again")

    def _go_back(self) -> None:
        """Forget the last answer of a person, and what was taken by itself behind it."""
        if not self._typed:
            self._say("this is the first question")
            return
        listens_behind = bus_of(self.answers).listens_behind
        keys = list(self.answers)
        for key in keys[keys.index(self._typed.pop()) :]:
            del self.answers[key]
            self._taken.pop(key, None)
        if listens_behind not in self.answers:
            self._heard, self._has_listened, self._deaf = None, False, None


_OF_CHANNELS = {"channels", "columns", "signals"}
"""Questions on what is measured."""
_COUNTERS = {"counter", "counter-byte"}
"""Questions on how samples are counted."""


def _answer(
    question: Question,
    ask: Callable[[Question], str],
    say: Callable[[str], None],
    answers: Answers,
    file: Path,
) -> bool:
    """Ask a person until there is an answer that can be used, and that is not most likely a mistake.

    Returns:
        Whether Enter took what is in brackets.
    """
    before = None
    while True:
        typed = ask(question)
        text = typed or question.default or ""
        reason = take(question, text, answers, file)
        if reason is None and question.doubt is not None and text != before:
            doubt = question.doubt(answers[question.key])
            if doubt is not None:
                reason, instead = doubt
                del answers[question.key]
                question = replace(question, default=instead, beside="")
        if reason is None:
            return not typed
        say(reason)
        before = text


def _offered(question: Question, heard: Heard, answers: Answers, file: Path) -> Question:
    """The question with what was heard as its default, where that can be used; then it is never quiet."""
    if question.choices and (wrong := heard.not_offered(answers).get(question.key)):
        shown = {choice: about for choice, about in question.choices.items() if choice not in wrong}
        question = replace(question, choices=shown)
    text, beside = heard.proposals(answers).get(question.key), heard.beside(answers).get(question.key, "")
    if text is not None and text == question.default:
        return replace(question, beside=beside)
    if text is None or take(question, text, dict(answers), file) is not None:
        return question
    return replace(question, default=text, quiet=False, beside=beside)


def take(question: Question, text: str, answers: Answers, file: Path) -> str | None:
    """Take an answer; why it cannot be taken, if so."""
    try:
        answers[question.key] = question.read(text)
    except ValueError as error:
        return f"{error}"
    reason = refusal(answers, file)
    if reason is not None:
        del answers[question.key]
    return reason


def refusal(answers: Answers, file: Path) -> str | None:
    """What ``daqsvc check`` would report if all other answers were the defaults; None if nothing."""
    complete = dict(answers)
    for question in questions(complete, file.parent):
        if question.key not in complete:
            if question.default is None:
                return None  # not known yet
            complete[question.key] = question.read(question.default)
    from daqsvc.settings.problems import AssemblyError, MachineFileError  # noqa: PLC0415 - slow to import

    try:
        checked(machine_text(complete, file.name), file)
    except MachineFileError as error:
        of_sensors = any(key.startswith(f"{SENSOR}.") for key in answers) or complete.keys() == answers.keys()
        # Of a sensor nothing has been answered yet: whoever is asked can still do so as it must be.
        known = [one for one in error.problems if of_sensors or not one.key.startswith("sensors")]
        if not known:
            return None
        problem = known[0]
        return f"{problem.subject}: {problem.message}. Remedy: {problem.remedy}"
    except AssemblyError as error:
        return f"{error}"
    return None


def checked(text: str, file: Path) -> MachineFile:
    """The machine file in a text, checked by what ``daqsvc check`` checks.

    Raises:
        MachineFileError: it cannot be used.
        AssemblyError: a file that it names cannot, or a bearing is not known.
    """
    from daqsvc.detectors.make import check_files  # noqa: PLC0415 - slow to import
    from daqsvc.publish.make import check_outputs  # noqa: PLC0415
    from daqsvc.settings.load import parse_machine_file  # noqa: PLC0415

    machine = parse_machine_file(text, file)
    check_files(machine)
    check_outputs(machine)
    return machine


def option(key: str) -> str:
    """How an answer is given on the command line."""
    if key.startswith(f"{SENSOR}."):
        return f"--{SENSOR} {key.removeprefix(f'{SENSOR}.')}="
    return f"--{key}"


def given_as(key: str, text: str) -> str:
    """An answer as it was given on the command line."""
    shown = text if text.strip() else repr(text)
    return f"{option(key)}{'' if key.startswith(f'{SENSOR}.') else ' '}{shown}"


def _missing(question: Question) -> str:
    text = question.topic.text
    words = f"{text if text.endswith('?') else f'{text}:'} give {option(question.key)}"
    more = "" if question.default is None else f", or --yes for {question.default} and all other defaults"
    return f"{words}{more}; there is no terminal to ask at"


def _refuse_for_listening(beforehand: Given) -> None:
    """What tells where to look is of no use to who does not look."""
    for key in {"seconds", *(key for bus in buses().values() for key in bus.for_listening)}:
        if key in beforehand.texts:
            raise AnswerError(
                f"{given_as(key, beforehand.texts[key])} is for --listen only; add --listen, or leave it out"
            )


def _refuse_of_other_buses(beforehand: Given, answers: Answers) -> None:
    """The same as `_refuse_others`, as soon as the bus is known and before a person has answered more."""
    for key in beforehand.texts:
        if _buses_of(key, answers):
            raise AnswerError(
                f"{option(key)} is not asked for with these answers; {_why_not_asked(key, (), answers)}"
            )


def _buses_of(key: str, answers: Answers) -> list[str]:
    """On which buses a question is asked that is not asked on this one; none if it is asked on any."""
    if key in SHARED or key in TOPICS or key in bus_of(answers).topics:
        return []
    return [word for word, bus in buses().items() if key in bus.topics]


def _refuse_others(beforehand: Given, interview: _Interview) -> None:
    """An answer to no question is a slip of the pen, or is of another bus."""
    asked = interview.asked
    for key in beforehand.texts:
        if key not in asked:
            if key == "class":
                _refuse_class(beforehand.texts[key])
            hint = _why_not_asked(key, asked, interview.answers)
            raise AnswerError(f"{option(key)} is not asked for with these answers; {hint}")


def _refuse_class(text: str) -> None:
    """Whoever names a class that there is not corrects that first, whatever else is missing."""
    try:
        q.one_of(CLASSES)(text)
    except ValueError as error:
        raise AnswerError(f"{given_as('class', text)}: {error}") from None


_NEEDS = {
    "username": "--broker",
    "password-file": "--broker and --username",
    "home-assistant": "--broker",
    "class": "--limits iso",
    "alert": "--limits own",
    "danger": "--limits own",
}
"""Questions that only some answers lead to."""
_INSTEAD = {"channels": "columns"}
"""Questions that ask for the same where the first of them is not asked."""


def _why_not_asked(key: str, asked: Sequence[str], answers: Answers) -> str:
    """What is missing for a question, or what was meant instead."""
    if other_buses := _buses_of(key, answers):
        return f"it needs --bus {' or '.join(other_buses)}"
    channels = bus_of(answers).channels(answers)
    channel = key.removeprefix(f"{SENSOR}.").rpartition(".")[0]
    if key.startswith(f"{SENSOR}.") and channel not in channels:
        return f"there is no channel {channel}; there are {', '.join(channels)}"
    if key.endswith(".bearing"):
        return why_no_bearing(answers)
    if key in _NEEDS:
        of_shaft = key == "class" and answers.get("limits") == "iso"
        return "probes on the shaft have no class: leave it out" if of_shaft else f"it needs {_NEEDS[key]}"
    other = _INSTEAD.get(key, key)
    if other in asked:
        return f"write {option(other)} instead"
    close = difflib.get_close_matches(key, asked, n=1)
    return f"did you mean {option(close[0])}?" if close else "leave it out"
