"""A quality alarm that stands says so when its cause is another one, and not when only figures differ."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest
from support.alarm_rig import AlarmRig, kinds

from daqsvc.alarms.quality import HEARD_NS, SensorHealth
from daqsvc.diagnosis.record import Diagnosis

if TYPE_CHECKING:
    from collections.abc import Sequence

    from daqsvc.alarms.events import AlarmEvent

SILENCE = "no samples of stream 's' for more than {} s; check bus and device"
RATE = "the device sends {} Hz, the file states 50"


def test_a_wrong_rate_takes_over_from_silence() -> None:
    doubts = SensorHealth()
    found = []
    for reason in (SILENCE.format(2.0), SILENCE.format(7.5), RATE.format(100.1), RATE.format(99)):
        doubts.update(
            Diagnosis("m", "levels", 1, "s", 5, 5, "N", quality="missing", reason=reason, sensors=("a",)), 1
        )
        found.append(doubts.finding("sensor-ok/a"))
    silent, longer, rate, other_rate = found
    assert silent.identity == longer.identity
    assert rate.identity == other_rate.identity
    assert silent.identity != rate.identity
    assert RATE.format(99) in other_rate.sentence


SILENT = "no samples of stream 'fan2': unit 33 at 192.0.2.1:502 {}"
NO_VALUE = "the last {} values of spare did not arrive, or the device had none; check sensor, device and bus"


def missing(rig: AlarmRig, reason: str, *, samples: bool, share: float | None = None) -> Sequence[AlarmEvent]:
    end = 7 if samples else 0
    return rig.take(
        detector="levels/spare",
        stream="fan2",
        first_index=0,
        end_index=end,
        decision="N",
        quality="missing",
        reason=reason,
        sensors=("spare",),
        missing_share=share,
    )


def test_one_reason_for_a_silence_takes_over_from_another() -> None:
    rig = AlarmRig()
    (raised,) = missing(rig, SILENT.format("has not answered within 500 ms"), samples=False)
    assert missing(rig, SILENT.format("has not answered within 400 ms"), samples=False) == []
    rig.tick(10.0)
    (changed,) = missing(rig, SILENT.format("refuses function 3"), samples=False)
    assert (changed.kind.value, changed.occurrence) == ("changed", raised.occurrence)
    assert rig.status("sensor-ok/spare").message.endswith("unit 33 at 192.0.2.1:502 refuses function 3")


@pytest.mark.parametrize("restarted", [False, True])
def test_a_silence_is_no_longer_the_reason_once_samples_come_again(restarted) -> None:
    """The device is back, and has no value for this sensor: its alarm stands, and is about that."""
    rig = AlarmRig()
    missing(rig, NO_VALUE.format(3), samples=True)
    rig.tick(10.0)
    silent = SILENT.format("has not answered within 500 ms")
    assert kinds(missing(rig, silent, samples=False)) == [("sensor-ok/spare", "changed")]
    if restarted:
        rig = rig.restarted({"levels/spare": ("spare",)})
    begun_ns = rig.clock.t_ns
    changed = []
    for number in range(3, 63):
        events = missing(rig, NO_VALUE.format(number), samples=True)
        changed += [(rig.clock.t_ns - begun_ns, event) for event in events]
    ((after_ns, event),) = changed
    assert event.kind.value == "changed"
    assert HEARD_NS <= after_ns <= HEARD_NS + 2_000_000_000
    assert "did not arrive, or the device had none" in rig.status("sensor-ok/spare").message
    assert rig.status("sensor-ok/spare").state.is_active


def test_a_statement_about_samples_just_after_a_silence_is_no_event() -> None:
    rig = AlarmRig()
    missing(rig, SILENT.format("has not answered within 500 ms"), samples=False)
    rig.tick(30.0)
    for number in range(3, 8):
        assert missing(rig, NO_VALUE.format(number), samples=True) == []
    assert missing(rig, SILENT.format("has not answered within 500 ms"), samples=False) == []


def test_a_mean_that_fills_up_after_a_silence_is_no_event_of_its_own() -> None:
    """Of ten values one more comes each second, and the next statement is good: that is the event."""
    rig = AlarmRig()
    missing(rig, SILENT.format("has not answered within 500 ms"), samples=False)
    rig.tick(30.0)
    for number in range(40):
        rig.tick(1.0)
        assert missing(rig, NO_VALUE.format(number), samples=True, share=1.0 - number / 50) == []
