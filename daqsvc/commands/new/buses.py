"""The kinds of buses that ``daqsvc new`` asks about; the questions of each are in its driver's folder."""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING

from daqsvc.commands.plugged import plugged
from drivers.bus_questions import BusQuestions
from drivers.can.dbc_questions import DbcQuestions
from drivers.can.questions import PackedQuestions, VirtualQuestions
from drivers.modbus.questions import RtuQuestions, TcpQuestions
from drivers.serial.questions import SerialQuestions

if TYPE_CHECKING:
    from drivers.questions import Answers

QUESTIONS = "daqsvc.questions"


@cache
def buses() -> dict[str, BusQuestions]:
    """Every kind of bus that can be asked about, by the word that ``--bus`` takes."""
    ours: dict[str, BusQuestions] = {
        "virtual": VirtualQuestions(),
        "can-dbc": DbcQuestions(),
        "can": PackedQuestions(),
        "modbus-tcp": TcpQuestions(),
        "modbus-rtu": RtuQuestions(),
        "serial": SerialQuestions(),
    }
    return ours | plugged(QUESTIONS, BusQuestions, "bus")  # type: ignore[type-abstract]


def bus_of(answers: Answers) -> BusQuestions:
    """The kind of bus that was answered."""
    return buses()[answers["bus"]]
