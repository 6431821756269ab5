"""Looks at bearings whose samples had to be put right clear nothing, and what they show still counts."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from support.bearing_signals import OUTER, RATE_HZ, SPEED_RPM, healthy, knocks

from daqsvc.acquisition.clock import NS_PER_S
from daqsvc.bearing.geometry import bearing_orders
from daqsvc.detectors.bearing.detector import BearingDetector
from daqsvc.detectors.bearing.housed import HousedBearing
from daqsvc.diagnosis.detector import Window

if TYPE_CHECKING:
    from daqsvc.diagnosis.record import Diagnosis

LOOK = round(2.5 * RATE_HZ)
GOOD_S, FAULT_S = 40.0, 20.0


def watched(samples: np.ndarray) -> list[Diagnosis]:
    bearing = HousedBearing("drive-end", "accel-de", 0, bearing_orders("6205-2RS"))
    watch = BearingDetector(
        machine="motor",
        stream="housing",
        rate_hz=RATE_HZ,
        speed_rpm=SPEED_RPM,
        bearings=[bearing],
        calibrate_s=1_000.0,
    )
    window = Window(0, samples.astype(np.float32)[:, np.newaxis], NS_PER_S, NS_PER_S / RATE_HZ)
    return list(watch.process(window))


def outer_then_good() -> np.ndarray:
    damaged = healthy(FAULT_S, 21) + knocks(FAULT_S, OUTER, 22, size=0.6)
    return np.concatenate([damaged, healthy(GOOD_S, 23)])


def test_looks_at_repaired_samples_take_no_fault_back() -> None:
    samples = outer_then_good()
    assert watched(samples)[-1].decision == "normal"
    samples[round(FAULT_S * RATE_HZ) + LOOK // 2 :: 2 * LOOK] = 30.0
    said = watched(samples)
    assert said[-1].decision == "outer"
    after = said[-8:]
    assert {d.quality for d in after} == {"not_ok"}
    assert all("accel-de: " in d.reason and "that no housing can follow" in d.reason for d in after)
    assert not any(d.probabilities for d in after), "they would contradict what is decided"


def test_a_fault_is_raised_through_outliers_and_the_reason_tells_of_them() -> None:
    samples = outer_then_good()[: round(FAULT_S * RATE_HZ)]
    samples[LOOK // 3 :: LOOK] = -50.0
    said = watched(samples)
    assert [d.decision for d in said[1:]] == ["outer"] * (len(said) - 1)
    assert {d.quality for d in said} == {"good"}
    assert all("that no housing can follow" in d.reason for d in said)


def test_a_look_with_drop_outs_is_not_ok_and_says_why() -> None:
    samples = outer_then_good()
    for begin in range(round(FAULT_S * RATE_HZ) + 500, len(samples) - 500, 4_000):
        samples[begin : begin + 150] = 0.0
    last = watched(samples)[-1]
    assert (last.decision, last.quality) == ("outer", "not_ok")
    assert "accel-de: channel stands still" in last.reason
