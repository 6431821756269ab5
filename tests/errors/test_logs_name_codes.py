"""Every line of the log from WARNING on has a code, as a field of its record and at its end."""

from __future__ import annotations

import ast
import io
import logging
import re
import ssl
from typing import TYPE_CHECKING

import pytest
from errors.test_errors_name_codes import FILES
from paho.mqtt.packettypes import PacketTypes
from paho.mqtt.reasoncodes import ReasonCode
from support.given_codes import Codes
from support.paths import ROOT

from daqsvc.acquisition.link import Link
from daqsvc.alarms.codes import OF_SERVICE, code_of_alarm
from daqsvc.cli import start_logging
from daqsvc.errors.buses import LINK_LOST
from daqsvc.errors.code import coded
from daqsvc.notice import NOTICE, notice
from daqsvc.publish.mqtt.errors import MqttCodeError, Outage, TakenOverError
from daqsvc.reference.alarms import OWN

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

LEVELS = {"warning", "warn", "error", "exception", "critical", "fatal"}
QUIET = {"logging.DEBUG", "logging.INFO", "NOTICE"}
CALLS = re.compile(rf"\b(?:{'|'.join(LEVELS)}|log)\b\s*\(")
"""Without one of these calls, a text is not parsed: that would take seconds for all of them."""


def lines(text: str) -> Iterator[tuple[ast.Call, ast.expr]]:
    """The calls that may write a line of the log from WARNING on, with their messages."""
    for node in ast.walk(ast.parse(text)) if CALLS.search(text) else ():
        if not (isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and node.args):
            continue
        logger = ast.unparse(node.func.value)
        is_parser = logger.endswith("parser") or logger == "root"
        if node.func.attr in LEVELS and not is_parser:
            yield node, node.args[0]
        elif node.func.attr == "log" and "log" in logger and ast.unparse(node.args[0]) not in QUIET:
            yield node, node.args[1]


def names_a_code(call: ast.Call) -> bool:
    """Whether a call hands over a code as a field of the record."""
    fields = next((ast.unparse(one.value) for one in call.keywords if one.arg == "extra"), "")
    return fields.startswith("coded(") and fields != "coded(None)"


SERVICE = [file for file in FILES if file.relative_to(ROOT).parts[0] != "sim_hw"]


def without_code(text: str) -> set[str]:
    return {ast.unparse(message) for call, message in lines(text) if not names_a_code(call)}


@pytest.mark.parametrize("file", SERVICE, ids=lambda file: str(file.relative_to(ROOT)))
def test_a_line_about_a_fault_names_a_code(file: Path) -> None:
    assert without_code(file.read_text(encoding="utf-8")) == set(), "good news have a level: daqsvc.notice"


@pytest.mark.parametrize(
    ("line", "is_found"),
    [
        ("log.warning('%s is away', name)", True),
        ("self._logger.error('away')", True),
        ("logging.getLogger(__name__).exception('away')", True),
        ("logging.warning('away')", True),
        ("log.critical('away', extra={'code': None})", True),
        ("log.error('away', extra=coded(None))", True),
        ("log.log(level, 'away')", True),
        ("log.log(logging.ERROR, 'away')", True),
        ("log.log(level, 'away', extra=coded(LINK_LOST))", False),
        ("log.warning('away', extra=coded(LINK_LOST))", False),
        ("log.log(logging.INFO, 'back')", False),
        ("log.log(NOTICE, 'back')", False),
        ("notice(log, 'back')", False),
        ("log.info('back')", False),
        ("task.exception()", False),
        ("self._parser.error('which has a code by itself')", False),
    ],
)
def test_a_line_without_a_code_is_found(line: str, *, is_found: bool) -> None:
    assert bool(without_code(line)) is is_found


def test_the_code_is_a_field_of_the_record_and_ends_the_line(caplog: pytest.LogCaptureFixture) -> None:
    handler = logging.StreamHandler(io.StringIO())
    start_logging(verbose=False, handler=handler)
    logging.getLogger("test").warning("%s is away", "can0", extra=coded(LINK_LOST))
    notice(logging.getLogger("test"), "%s is back", "can0")
    coded_one, plain = caplog.records
    assert coded_one.__dict__["code"] is LINK_LOST
    assert handler.format(coded_one).endswith("WARNING can0 is away [B29]")
    assert handler.format(plain).endswith("NOTICE can0 is back")


@pytest.mark.parametrize(("verbose", "shown"), [(False, NOTICE), (True, logging.INFO)])
def test_good_news_are_shown_by_default(
    *, verbose: bool, shown: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    root = logging.getLogger()
    monkeypatch.setattr(root, "handlers", [])
    monkeypatch.setattr(root, "level", root.level)
    start_logging(verbose=verbose, handler=logging.NullHandler())
    assert root.level == shown
    assert logging.INFO < NOTICE < logging.WARNING
    assert logging.getLevelName(NOTICE) == "NOTICE"


def test_good_news_are_of_the_module_that_has_them(caplog: pytest.LogCaptureFixture) -> None:
    notice(logging.getLogger("test"), "%s is back", "can0")
    (record,) = caplog.records
    assert (record.levelno, record.getMessage(), record.pathname) == (NOTICE, "can0 is back", __file__)


def test_a_warning_without_a_code_is_found() -> None:
    codes = Codes()
    for name, level, code in (
        ("daqsvc.test", logging.WARNING, None),
        ("drivers.test", logging.ERROR, None),
        ("daqsvc.test", logging.WARNING, LINK_LOST),
        ("daqsvc.test", NOTICE, None),
        ("another", logging.WARNING, None),
    ):
        line = {"name": name, "levelno": level, "levelname": logging.getLevelName(level), "msg": "away"}
        codes.handle(logging.makeLogRecord(line | coded(code)))
    assert codes.lacking == ["WARNING away", "ERROR away"]


def codes_of_faults(caplog: pytest.LogCaptureFixture) -> list[str]:
    return [f"{record.__dict__['code']}" for record in caplog.records if "code" in record.__dict__]


def test_a_link_has_the_code_of_why_it_is_down(caplog: pytest.LogCaptureFixture) -> None:
    link = Link("can0")
    link.down("nobody is there")
    assert link.code is LINK_LOST
    link.up()
    assert link.code is None
    link.fail("its reader failed", ValueError("odd"))
    assert f"{link.code}" == "B31"
    link.leave_out("nobody is there")
    assert f"{link.code}" == "B30"
    link.end("all was played")
    assert link.code is None
    assert codes_of_faults(caplog) == ["B29", "B31", "B30"]


@pytest.mark.gives("O10", "O11")
def test_what_keeps_a_broker_away_has_a_code(caplog: pytest.LogCaptureFixture) -> None:
    refused = ReasonCode(PacketTypes.CONNACK, "Not authorized")
    for error in (
        ConnectionRefusedError(),
        ssl.SSLError(1, "no shared cipher"),
        MqttCodeError(refused),
        TakenOverError(),
        FileNotFoundError(2, "No such file", "password"),
    ):
        Outage(logging.getLogger("test")).tell("the broker", error, "it is tried again")
    assert codes_of_faults(caplog) == ["O09", "O10", "O11", "O13", "O01"]


@pytest.mark.gives("B29", "B31")
def test_a_test_that_gives_its_codes_passes() -> None:
    link = Link("can0")
    link.down("nobody is there")
    link.fail("its reader failed", ValueError("odd"))


@pytest.mark.gives("Z99")
@pytest.mark.xfail(raises=AssertionError, reason="what the mark is for")
def test_a_test_that_does_not_give_its_code_fails() -> None:
    Link("can0").down("nobody is there")


def test_every_alarm_of_the_service_has_a_code() -> None:
    of_handling = {"alarm-flood", "trip-multiply"}  # nothing is wrong with data or service
    assert OF_SERVICE.keys() == OWN.keys() - of_handling
    assert f"{code_of_alarm('sensor-ok/probe-x', 'missing')}" == "D22"
    assert f"{code_of_alarm('sensor-ok/probe-x', 'not_ok')}" == "D21"
    assert f"{code_of_alarm('certificate/broker', 'good')}" == "O23"
    assert code_of_alarm("housing", "good") is None
