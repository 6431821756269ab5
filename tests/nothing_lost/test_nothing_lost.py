"""Every alarm that is on disk reaches its consumer, whatever happens to process, disk, broker and network.

``make nothing-lost`` runs two hundred of these; here are enough to see what has broken.
"""

from __future__ import annotations

import os

import pytest
from nothing_lost.broker import mosquitto_program
from nothing_lost.many import courses, run_all
from nothing_lost.run import Course
from nothing_lost.script import HOUR_S, Script

AT_A_TIME = 8

pytestmark = [pytest.mark.mosquitto, pytest.mark.timeout(400)]


@pytest.fixture(autouse=True)
def _mosquitto():
    if mosquitto_program() is None:
        reason = "no mosquitto on this machine (apt-get install mosquitto)"
        if os.environ.get("DAQSVC_REQUIRE_MOSQUITTO") == "1":
            pytest.fail(reason)
        pytest.skip(reason)


@pytest.mark.long
async def test_nothing_is_lost(tmp_path):
    reports = await run_all(courses(24), tmp_path, AT_A_TIME)
    assert not [str(report) for report in reports if report.verdict.violations]
    # What did not happen proves nothing.
    assert {report.course.broker for report in reports} == {"mosquitto", "amqtt"}
    assert sum(report.verdict.repeats for report in reports) > 0
    assert sum(report.kills for report in reports) >= 2 * len(reports)
    befell = {kind for report in reports for kind in report.befell}
    assert {"disk full", "broker restart", "broker kill", "half open", "one byte slices"} <= befell


@pytest.mark.long
@pytest.mark.parametrize("mutation", ["none", "bypass", "forget-early"])
async def test_only_without_a_working_outbox_something_is_lost(tmp_path, mutation):
    befalls = ("half_open_for_good", "kill") * 3
    reports = await run_all(
        [Course(seed, mutation=mutation, befalls=befalls) for seed in (101, 102)], tmp_path, AT_A_TIME
    )
    for report in reports:
        lost = [v for v in report.verdict.violations if "was committed and never reached the consumer" in v]
        assert bool(lost) == (mutation != "none"), report


@pytest.mark.long
async def test_wall_clock_steps_and_a_suspension_move_nothing(tmp_path):
    course = Course(5, befalls=("suspend_for_long",))
    offsets_s = {step.wall_offset_s for step in Script.of_seed(course.seed).steps}
    assert offsets_s == {-HOUR_S, 0, HOUR_S}
    [report] = await run_all([course], tmp_path, 1)
    assert report.befell == ["suspend for long"]
    assert report.verdict.violations == []
