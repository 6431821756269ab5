"""What [store] of a machine file says, and what the outbox is told."""

from __future__ import annotations

import pytest
from support.machine_files import LAVAL, only_problem, parsed

from daqsvc.outbox.limits import MIB, NS_PER_DAY, OutboxLimits
from daqsvc.settings import parse_machine_file

DIRECTORY = 'directory = "/var/lib/daqsvc"'


def limits_with(*lines):
    return OutboxLimits.of(parsed(LAVAL, (DIRECTORY, "\n".join([DIRECTORY, *lines, ""]))).store)


def test_what_is_not_said_has_the_limits_of_an_outbox_that_was_told_nothing():
    assert limits_with() == OutboxLimits()
    without = LAVAL.read_text(encoding="utf-8").split("[store]")[0]
    assert OutboxLimits.of(parse_machine_file(without, LAVAL).store) == OutboxLimits()


def test_every_limit_reaches_the_outbox_in_its_unit():
    assert limits_with(
        "alarms_max_mb = 10",
        "alarms_keep_days = 0.5",
        "telemetry_max_mb = 3",
        "telemetry_max_age_s = 1.5",
        "reserve_mb = 7",
        "audit_max_mb = 5",
    ) == OutboxLimits(
        alarms_max_bytes=10 * MIB,
        alarms_keep_ns=NS_PER_DAY // 2,
        telemetry_max_bytes=3 * MIB,
        telemetry_max_age_ns=1_500_000_000,
        reserve_bytes=7 * MIB,
        audit_max_bytes=5 * MIB,
    )


@pytest.mark.parametrize(
    ("key", "value", "words"),
    [
        ("alarms_max_mb", "0", "1 or more"),
        ("alarms_max_mb", "1.5", "whole number"),
        ("alarms_keep_days", "0", "0.001 or more"),
        ("telemetry_max_age_s", "-1", "1 or more"),
        ("reserve_mb", "-1", "0 or more"),
        ("audit_max_mb", "0", "1 or more"),
    ],
)
def test_a_limit_that_is_none_is_refused_by_name(key, value, words):
    problem, _ = only_problem(LAVAL, (DIRECTORY, f"{key} = {value}\n{DIRECTORY}"))
    assert f"store.{key}" in str(problem)
    assert words in str(problem)
