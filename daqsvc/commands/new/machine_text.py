"""A whole new machine file: what is asked, in order, and its text."""

from __future__ import annotations

import textwrap
from typing import TYPE_CHECKING

from daqsvc.commands.new.assumed import marked
from daqsvc.commands.new.buses import bus_of, buses
from daqsvc.commands.new.sensors import (
    alarm_tables,
    limit_questions,
    pipeline_tables,
    sensor_questions,
    sensor_tables,
)
from daqsvc.commands.new.topics import TOPICS
from drivers import questions as q
from drivers.questions import NONE, Answers, Question
from drivers.toml_lines import entry

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

_WIDTH = 100
NOTES = "notes"
"""Key, beside the answers, of sentences on what in the file was neither answered nor heard."""
SCHEMA_FILE = "machine.schema.json"
"""Beside the machine file, so that it is found without a network, wherever daqsvc is installed."""
SCHEMA_COMMAND = f"daqsvc check --schema > {SCHEMA_FILE}"


def questions(answers: Answers, folder: Path) -> Iterator[Question]:
    """The questions, each as the answers before make it.

    Args:
        answers: those before; whoever takes a question puts its answer there before the next one.
        folder: of the machine file, where relative paths start.
    """
    choices = {word: bus.about for word, bus in buses().items()}
    yield Question("bus", TOPICS["bus"], q.one_of(choices), "virtual", choices)
    bus = bus_of(answers)
    virtual = bus.simulated
    yield Question("name", TOPICS["name"], q.title, "rig" if virtual else "machine")
    yield Question("site", TOPICS["site"], q.name, "plant", quiet=True)
    yield Question("box", TOPICS["box"], q.name, "edge-1", quiet=True)
    yield Question("seconds", TOPICS["seconds"], q.seconds_or_auto, q.AUTO, quiet=True)
    yield from bus.questions(answers, folder)
    speed, usual = TOPICS["speed"], "600" if virtual else "1480"
    yield Question("speed", speed, q.speed_rpm, usual, quiet=virtual, doubt=q.doubt_of_speed)
    yield Question("rate", TOPICS["rate"], q.rate_hz, f"{bus.rate_hz(answers):g}", quiet=virtual)
    yield from sensor_questions(answers)
    yield from limit_questions(answers)
    yield from _broker_questions(answers)


def _broker_questions(answers: Answers) -> Iterator[Question]:
    yield Question("broker", TOPICS["broker"], q.text_or_none, NONE)
    if answers["broker"] is None:
        return
    yield Question("username", TOPICS["username"], q.text_or_none, NONE)
    if answers["username"] is not None:
        file = "/etc/daqsvc/mqtt-password"
        yield Question("password-file", TOPICS["password-file"], q.line, file)
    yield Question("home-assistant", TOPICS["home-assistant"], q.yes_no, "no", q.YES_NO)


def machine_text(answers: Answers, file: str) -> str:
    """The text of the machine file.

    Args:
        answers: to all `questions`.
        file: its name, for the commands that its first comment shows.
    """
    lines = [*_head(answers, file), *marked(_tables(answers), answers)[0]]
    return "\n".join(line.rstrip() for line in lines).rstrip() + "\n"


def assumed_words(answers: Answers) -> list[str]:
    """A sentence on the keys of the file that nobody has stated; none if there are none."""
    keys = marked(_tables(answers), answers)[1]
    if not keys:
        return []
    return [f'Assumed, as nobody has stated it: {", ".join(keys)}. Correct the lines marked "assumed".']


def _tables(answers: Answers) -> list[str]:
    """Lines of all tables."""
    lines = [*_machine(answers), *bus_of(answers).tables(answers), ""]
    return [
        *lines,
        *sensor_tables(answers),
        *pipeline_tables(answers),
        *alarm_tables(answers),
        *_broker(answers),
    ]


def _head(answers: Answers, file: str) -> Iterator[str]:
    # Editors look for this comment at the very top.
    yield f"#:schema ./{SCHEMA_FILE}"
    yield f"# {answers['name']}: a machine file of daqsvc, made by daqsvc new."
    yield "#"
    yield f"#   daqsvc check {file}    shows what it understood, or all errors"
    yield f"#   daqsvc run {file}      watches the machine; while it runs, after a change here:"
    yield f"#   daqsvc reload {file}   takes the change over"
    yield "#"
    yield "# The first line is for editors. They help with keys and values if the file that it names exists:"
    yield f"#   {SCHEMA_COMMAND}"
    yield "#"
    yield "# Change first: the sensors (sensitivities, places), then the limits of the alarms."
    yield "# Units are part of every name. Relative paths start at the folder of this file."
    if notes := answers.get(NOTES):
        yield "#"
        yield from (f"# {line}" for note in notes for line in _wrapped(note))
    yield ""


def _wrapped(note: str) -> list[str]:
    """Its lines; a path or option that is broken at a hyphen could not be found or copied."""
    return textwrap.wrap(note, _WIDTH, break_on_hyphens=False, break_long_words=False)


def _machine(answers: Answers) -> Iterator[str]:
    yield entry("schema_version", 1)
    yield entry("site", answers["site"], "site, box and machine are part of every topic")
    yield entry("box", answers["box"], "the computer that daqsvc runs on")
    yield ""
    yield "[machine]"
    yield entry("name", q.short_name(answers["name"]))
    if answers["name"] != q.short_name(answers["name"]):
        yield entry("description", answers["name"])
    yield entry("speed_rpm", answers["speed"], "nominal; negative if the shaft turns clockwise")
    yield ""


def _broker(answers: Answers) -> Iterator[str]:
    url = answers["broker"]
    if url is None:
        yield "# Alarms are kept on this box: daqsvc alarms shows them. To send them to an MQTT broker, too:"
        yield "# [mqtt]"
        yield '# url = "mqtts://broker.example:8883"'
        return
    yield "[mqtt]"
    yield entry("url", url)
    if url.startswith("mqtt://"):
        yield entry("insecure", value=True, comment="accepts that nothing is encrypted")
    if answers["username"] is not None:
        yield entry("username", answers["username"])
        yield entry("password_file", answers["password-file"], "its first line; only daqsvc may read it")
    if answers["home-assistant"]:
        yield ""
        yield "[mqtt.home_assistant]            # the machine shows up there by itself"
