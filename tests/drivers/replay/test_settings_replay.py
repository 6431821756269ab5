"""Recordings in a machine file: what fits together is described, what does not is named with its line."""

from __future__ import annotations

from pathlib import Path

import pytest

from daqsvc.settings import parse_machine_file
from daqsvc.settings.describe import describe
from daqsvc.settings.problems import MachineFileError

TEXT = """
schema_version = 1
site = "lab"
box = "edge-1"
[machine]
name = "replayed"
speed_rpm = 600.0
[buses.tape]
driver = "replay"
file = "gap.npz"
at_end = "loop"
[streams.shaft]
bus = "tape"
rate_hz = 640.0
layout = { columns = [{ name = "x", column = "probe_v" }] }
[[sensors]]
name = "casing-x"
type = "accelerometer"
stream = "shaft"
channel = "x"
unit = "g"
"""
FRAMES = """{ id = 1, length = 8, counter = { byte = 0, bits = 16, counts = "samples" }, first_byte = 2, \
samples_per_frame = 1, channels = [{ name = "x", type = "int16", scale = 1.0 }] }"""
COLUMNS = '{ columns = [{ name = "x", column = "probe_v" }] }'
MODBUS = """{ way = "registers", unit = 1, channels = [{ name = "x", address = 0, type = "int16" }] }"""


def test_a_recording_is_described() -> None:
    text = describe(parse_machine_file(TEXT, Path("/m/replayed.toml")))
    assert "replay of gap.npz, again and again" in text
    assert "columns probe_v" in text


def test_a_can_log_takes_frames() -> None:
    machine = parse_machine_file(
        TEXT.replace("gap.npz", "gap.blf").replace(COLUMNS, FRAMES), Path("/m/replayed.toml")
    )
    assert machine.resolve(machine.buses["tape"].file) == Path("/m/gap.blf")


def test_one_channel_of_a_can_log_is_described() -> None:
    text = TEXT.replace('"gap.npz"', '"gap.blf"\nchannel = "2"').replace(COLUMNS, FRAMES)
    assert "replay of gap.blf, channel 2, again" in describe(
        parse_machine_file(text, Path("/m/replayed.toml"))
    )


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ('"loop"', '"wait"', 'buses.tape.at_end = "wait": gap.npz cannot be read while it is written'),
        ('"loop"', '"rewind"', "buses.tape.at_end"),
        ('"loop"', '"loop"\nchannel = "1"', 'buses.tape.channel = "1": means nothing to a table of samples'),
        ("gap.npz", "gap.db", "gap.db.*is a data base.*can_logconvert gap.db gap.blf"),
        ("gap.npz", "gap.db.gz", 'gap.db.gz": has an ending that no reader is known for.*give a CAN log'),
        ("gap.npz", "gap.xyz", r'file = "gap.xyz": has an ending .* \(.blf, .asc, .*\) or a table \(.npz, '),
        ("gap.npz", "gap", 'file = "gap": has an ending that no reader is known for'),
        (
            "gap.npz",
            "gap.blf",
            "layout.columns = .* has no columns: only the replay of a table has",
        ),
        (COLUMNS, FRAMES, "replays columns of a table, and this describes something else"),
        (COLUMNS, MODBUS, "replays columns of a table, and this describes something else"),
        (
            '"probe_v" }',
            '"probe_v", scale = 0.0 }',
            r"columns\[0\].scale = 0.0: would make every sample the same",
        ),
        ('"probe_v" }]', '"probe_v" }, { name = "x", column = "t" }]', r"columns\[1\].name = \"x\""),
    ],
)
def test_what_does_not_fit_is_named(old: str, new: str, said: str) -> None:
    assert old in TEXT
    with pytest.raises(MachineFileError, match=said):
        parse_machine_file(TEXT.replace(old, new), Path("/m/replayed.toml"))


def test_what_is_no_file_is_named_and_what_is_not_there_yet_may_come(tmp_path: Path) -> None:
    parse_machine_file(TEXT, tmp_path / "replayed.toml")
    (tmp_path / "gap.npz").mkdir()
    with pytest.raises(MachineFileError, match=r'buses.tape.file = "gap.npz": is no file but a folder'):
        parse_machine_file(TEXT, tmp_path / "replayed.toml")
