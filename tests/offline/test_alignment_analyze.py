"""A recording has all its channels on one grid: whatever their buses, a detector judges it the same."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Any

import pytest
from support.machine_files import LAVAL
from support.orbit_files import SPEED_RPM, Orbit

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

pytestmark = pytest.mark.integration
SECOND_STREAM = """
[streams.second]
bus = "can0"
rate_hz = 640.0
[streams.second.layout]
id = 0x1F0
length = 8
counter = { byte = 0, bits = 16, counts = "samples" }
first_byte = 2
samples_per_frame = 3
channels = [{ name = "x2", type = "int16", scale = 0.001 }]

[pipeline.alignment]

[pipeline.rotor_bank]"""


@pytest.mark.long
def test_a_bank_with_probes_in_two_streams_says_what_it_says_of_one(
    analyze: Callable[..., Any], tmp_path: Path
) -> None:
    file = Orbit().save(tmp_path / "a.npz")
    text = LAVAL.read_text()
    for key, value in {"speed_rpm": SPEED_RPM, "natural_frequency_hz": 50.0}.items():
        text = re.sub(rf"^{key} = [\d.]+", f"{key} = {value}", text, flags=re.MULTILINE)
    one, two = tmp_path / "one.toml", tmp_path / "two.toml"
    one.write_text(text)
    text = text.replace("\n[pipeline.rotor_bank]", SECOND_STREAM, 1)
    text = text.replace('stream = "shaft"\nchannel = "x"', 'stream = "second"\nchannel = "x2"', 1)
    two.write_text(text)
    said = []
    for machine in (one, two):
        code, (found,), _ = analyze(machine, file, "--map", "kph=keyphasor", "--map", "probe-x=x")
        assert code in {0, 3}
        said.append(found["detectors"]["rotor-bank"])
    assert said[0]["history"]
    assert said[1] == said[0]
