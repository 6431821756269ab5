"""What buses, streams and sensors are called, whoever proposes the tables."""

from __future__ import annotations

from typing import TYPE_CHECKING

from drivers import names

if TYPE_CHECKING:
    from pathlib import Path

    import pytest


def test_a_port_is_called_alike_by_its_short_and_by_its_lasting_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    port, lasting = tmp_path / "ttyUSB0", tmp_path / "serial" / "by-id" / "usb-FTDI_FT232R_A50285BI-if00"
    port.touch()
    lasting.parent.mkdir(parents=True)
    lasting.symlink_to(port)
    monkeypatch.setattr(names, "_LASTING", tmp_path / "serial")
    assert [names.bus_name(f"{one}", "serial0") for one in (port, lasting)] == ["ttyUSB0", "ttyUSB0"]
    link = tmp_path / "pump-port"
    link.symlink_to("/dev/null")
    assert names.bus_name(f"{link}", "serial0") == "pump-port", "a link that a person has made is a name"


def test_names_keep_the_letters_of_the_device_and_need_no_quotes() -> None:
    assert names.message_stream("VibDE") == "VibDE"
    assert names.lines_stream("$ACC") == "ACC"
    assert (names.lines_stream(None), names.lines_stream("$")) == ("lines", "lines")
    assert names.bus_name("/", "can0") == "can0"
    assert names.sensor_name("VibDE", "accelerometer", "Vib") == "accel-VibDE"
    assert names.sensor_name("Öl", "trend", "K1", by_stream=True) == "K1-l"
    assert len(names.sensor_name("x" * 80, "velocity", "K1")) == names.LONGEST_NAME


def test_what_is_called_like_a_register_has_the_name_of_its_stream_before_it() -> None:
    """Several tables of a line have a register of that number."""
    streams = [names.unit_stream(17, table) for table in ("holding", "input")]
    found = [names.sensor_name("r2", "trend", stream) for stream in streams]
    assert found == ["unit-17-r2", "unit-17-input-r2"]
    assert names.sensor_name("rpm2", "trend", "unit-17") == "rpm2"


def test_a_name_that_is_taken_gets_a_number_and_stays_short_enough() -> None:
    taken: set[str] = set()
    given = [names.unused("x" * 70, taken) for _ in range(3)]
    assert len(set(given)) == 3
    assert max(map(len, given)) <= names.LONGEST_NAME
