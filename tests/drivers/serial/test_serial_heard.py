"""What ``daqsvc new --listen`` makes of what came over a serial port: its file, and its words."""

from __future__ import annotations

import math
import struct
import tomllib
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from cobs import cobs
from support.only_table import only_bus, only_stream

from daqsvc.commands.new.interview import Given, conduct
from daqsvc.commands.new.machine_text import machine_text
from daqsvc.settings import parse_machine_file
from drivers.serial.checksums import CHECKSUMS
from drivers.serial.heard import HeardOnSerial
from drivers.serial.questions import SerialQuestions
from drivers.serial.recognise import recognised
from drivers.serial.sniff_report import Heard, Report, Tried

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from drivers.sniffing import Sniffed


def sniffed(sends: Callable[[int], bytes], rate_hz: float, *, seconds: float = 3.0) -> Sniffed:
    """What a port is found to bring from a device that sends so often."""
    data, marks = bytearray(), []
    for number in range(1 + round(seconds * rate_hz)):
        data += sends(number)
        marks.append((len(data), number / rate_hz))
    heard = Heard(bytes(data), len(data), 0.0, marks[-1][1], 0, marks=tuple(marks))
    return Report("ttyS1", [], Tried(115_200, "none", heard, recognised(heard.data)), True).sniffed()


def written(found: Sniffed, file: Path, **given: str) -> tuple[dict[str, Any], str]:
    """The file of ``daqsvc new --listen --yes``, which check accepts; and its text, unwrapped."""
    heard = HeardOnSerial(found.figures, SerialQuestions())
    texts = {"bus": "serial", "port": "/dev/ttyS1", "name": "fan"} | given
    answers = conduct(file, Given(texts, defaults=True), None, print, lambda *_: heard)
    text = machine_text(answers, file.name)
    parse_machine_file(text, file)
    return tomllib.loads(text), text.replace("\n# ", " ")


def crc(name: str, payload: bytes, order: str) -> bytes:
    number = int(CHECKSUMS[name].of(np.frombuffer(payload, np.uint8)[None])[0])
    return number.to_bytes(2, "big" if order == "big" else "little")


def many_values(number: int) -> bytes:
    """A count and ten values, high byte first."""
    values = [int(1800 * math.sin(0.7 * (8 * number + k))) for k in range(8)]
    payload = struct.pack(">H10h", number, *values, 583, 1478 + number % 3)
    return cobs.encode(payload + crc("ibm-3740", payload, "big")) + b"\0"


@pytest.mark.parametrize("rate_hz", [50.0, 400.0])
def test_names_that_nobody_gave_are_no_reason_for_limits(tmp_path: Path, rate_hz: float) -> None:
    file, text = written(sniffed(many_values, rate_hz, seconds=8.0), tmp_path / "m.toml")
    assert "alarms" not in file
    assert {one["channel"] for one in file["sensors"]} == {"c1", "c2", "c3"}
    assert "a guess by the rate" in text


def test_a_keyphasor_by_name_is_no_accelerometer_where_it_is_not_in_volts(tmp_path: Path) -> None:
    found = sniffed(many_values, 400.0, seconds=8.0)
    file, _ = written(found, tmp_path / "m.toml", channels="x, y, kph")
    assert [one["type"] for one in file["sensors"]] == ["accelerometer", "accelerometer", "trend"]
    assert "alarms" not in file


def counted(number: int, *, width: str = "<H", begin: int = 0, crc_name: str = "xmodem") -> bytes:
    """A count, four values that swing, a temperature and a speed, low byte first."""
    values = [int(1800 * math.sin(0.7 * (4 * number + k))) for k in range(4)]
    order = width[0]
    count = (begin + number) % 256 ** struct.calcsize(width)
    payload = struct.pack(width, count) + struct.pack(f"{order}6h", *values, 583 + number % 5, 1478)
    return b"\x55\xaa" + payload + crc(crc_name, payload, "big")


@pytest.mark.parametrize(
    ("width", "begin", "seconds", "expected"),
    [
        ("<H", 0, 3.0, {"byte": 0, "bits": 16}),
        ("<H", 0x1210, 3.0, {"byte": 0, "bits": 16}),
        (">H", 0, 3.0, {"byte": 0, "bits": 16}),
        ("<I", 0, 3.0, {"byte": 0, "bits": 32}),
        ("<B", 0, 3.0, {"byte": 0, "bits": 8}),
        ("<B", 0, 8.0, {"byte": 0, "bits": 8}),
        ("<H", 0x12FF, 8.0, {"byte": 0, "bits": 16}),
    ],
)
def test_a_counter_that_has_not_carried_shifts_no_values(
    tmp_path: Path, width: str, begin: int, seconds: float, expected: dict[str, int]
) -> None:
    found = sniffed(lambda number: counted(number, width=width, begin=begin), 50.0, seconds=seconds)
    file, text = written(found, tmp_path / "m.toml")
    proposed = tomllib.loads(found.fragment)["streams"]["frames"]["layout"]
    for layout in (only_stream(file)["layout"], proposed):
        assert {key: layout["counter"][key] for key in expected} == expected
        assert layout["first_byte"] == struct.calcsize(width)
        assert len(layout["channels"]) == 6
    assert only_stream(file)["layout"]["byte_order"] == ("big" if width == ">H" else "little")
    carried = seconds == 8.0 or width == "<B"
    words = f"That the counter has {expected['bits']} bits is a guess: its upper bytes did not change."
    shown = "\n".join(one for one in found.parts if isinstance(one, str))
    heard = "\n".join(HeardOnSerial(found.figures, SerialQuestions()).lines)
    for place in (shown, heard, text, found.fragment.replace("\n# ", " ")):
        assert (words in place) != carried
        assert ("--seconds 7" in place) == (not carried and expected["bits"] < 32)


def unchecked(number: int) -> bytes:
    """A sync word, a count, and a temperature whose upper byte stands still."""
    return b"\x7e" + struct.pack("<Bhh", number & 255, int(1800 * math.sin(1.7 * number)), 583 + number % 5)


def test_without_a_check_the_sync_word_is_called_a_guess(tmp_path: Path) -> None:
    found = sniffed(unchecked, 50.0, seconds=8.0)
    assert found.figures["crc"] == ""
    file, text = written(found, tmp_path / "m.toml")
    words = f"That frames begin with {only_bus(file)['sync_word']} is a guess, as they have no check"
    shown = "\n".join(one for one in found.parts if isinstance(one, str))
    heard = "\n".join(HeardOnSerial(found.figures, SerialQuestions()).lines)
    for place in (shown, heard, text, found.fragment.replace("\n# ", " ")):
        assert words in place
        assert "correct sync_word by the device's manual" in place
    checked = sniffed(counted, 50.0)
    assert "is a guess, as they have no check" not in checked.fragment


def of_lines(form: str, rate_hz: float = 10.0) -> Sniffed:
    """What a device is found to send; n counts, v is a vibration, t a temperature, both as 1.85."""
    rng = np.random.default_rng(1)

    def line(number: int) -> bytes:
        v, t = 1.7 + rng.random() / 5, 58 + rng.random() / 2
        over = ">20.00" if number % 20 > 10 else f"{v:.2f}"
        hexed = f"{number:04X},{int(v * 100):04X},{int(t * 10):04X}"
        return f"{form.format(n=number, v=v, t=t, over=over, hexed=hexed)}\r\n".encode()

    return sniffed(line, rate_hz, seconds=6.0)


@pytest.mark.parametrize(
    ("form", "suffixes"),
    [
        ("{n};{v:.2f} mm/s RMS;{t:.1f} Grad", ["mm/s RMS", "Grad"]),
        ("{n};{v:.2f}mm/s(eff);{t:.1f} °C", ["mm/s(eff)", "°C"]),
        ("{n};{v:.2f} um p-p;{t:.1f}C", ["um p-p", "C"]),
    ],
)
def test_how_a_level_was_made_may_be_behind_its_unit(tmp_path: Path, form: str, suffixes: list[str]) -> None:
    file, _ = written(of_lines(form), tmp_path / "m.toml")
    assert [one["suffix"] for one in only_stream(file)["layout"]["channels"]] == suffixes


def test_why_a_column_is_left_out_shows_what_is_no_number(tmp_path: Path) -> None:
    _, text = written(of_lines("{n};{over};{t:.1f}"), tmp_path / "m.toml")
    assert 'c2 is left out, as not every line has a number there, but e.g. ">20.00".' in text
    _, text = written(of_lines("{n};{v:.2f} mm of oil;{t:.1f}"), tmp_path / "m.toml")
    assert 'write suffix = "mm of oil" in its channel if this is always there' in text


@pytest.mark.parametrize(
    ("begin", "turns", "bits"), [(65_000, 2**32, None), (65_500, 65_536, 16), (220, 256, 8), (7, 2**32, None)]
)
def test_sniff_and_new_take_the_width_of_a_counter_that_was_seen(
    tmp_path: Path, begin: int, turns: int, bits: int | None
) -> None:
    """A width that is too narrow loses all lines for ever once the count has passed it."""
    found = sniffed(lambda number: b"%d;%d.25\r\n" % ((begin + number) % turns, number % 7), 20.0)
    file, text = written(found, tmp_path / "m.toml")
    counters = [only_stream(one)["layout"]["counter"] for one in (tomllib.loads(found.fragment), file)]
    assert counters == [{"column": "c1"} | ({} if bits is None else {"bits": bits})] * 2
    guess = "32 bits is a guess: write bits = 16 in it if it begins again at 0 after 65535"
    assert [guess in one.replace("\n# ", " ") for one in (text, found.fragment)] == [bits is None] * 2
    assert any("c1 counts lines" in line for line in HeardOnSerial(found.figures, SerialQuestions()).lines)


@pytest.mark.parametrize("characters", [15, 16, 17, 31, 32])
def test_a_name_in_front_of_a_number_is_found_as_long_as_a_prefix_can_be(
    tmp_path: Path, characters: int
) -> None:
    name = "Lagertemperatur_des_vorderen_Lagers_der_Pumpe"[: characters - 1] + "="
    found = of_lines(f"{{n}};{{v:.2f}};{name}{{t:.1f}} °C")
    file, text = written(found, tmp_path / "m.toml")
    for one in (file, tomllib.loads(found.fragment)):
        channels = only_stream(one)["layout"]["channels"]
        assert [channel.get("prefix") for channel in channels] == [None, name]
    assert "left out" not in text


@pytest.mark.parametrize(
    ("form", "said"),
    [
        (f"{'T' * 32}={{t:.1f}} °C", f'"{"T" * 32}=" in front of its number has 33 characters, and prefix'),
        (f"{{t:.1f}} {'C' * 33}", f'"{"C" * 33}" behind its number has 33 characters, and suffix'),
        (f"T={{t:.1f}} {'C' * 33}", f'"{"C" * 33}" behind its number has 33 characters, and suffix'),
    ],
)
def test_what_is_too_long_beside_a_number_is_the_reason_why_a_column_is_left_out(
    tmp_path: Path, form: str, said: str
) -> None:
    found = of_lines(f"{{n}};{{v:.2f}};{form}")
    _, text = written(found, tmp_path / "m.toml")
    heard = (
        f"is left out: {said} takes 32 at most. If it is to be watched, have the device send a shorter text."
    )
    for place in (text, found.fragment):
        assert heard in place.replace("\n# ", " ")
        assert "not every line" not in place


def test_a_line_that_is_quoted_shows_that_more_of_it_follows() -> None:
    found = of_lines("{n};" + ";".join(["{t:.1f}"] * 40))
    shown = [one for one in found.parts if isinstance(one, str) and one.startswith("The first lines")]
    assert all(line.endswith("...") for line in shown[0].splitlines()[1:])


def test_of_columns_of_hex_none_is_kept_as_a_decimal_number() -> None:
    found = of_lines("{hexed}")
    assert [one["numeric"] for one in found.figures["columns"]] == [False, False, False]
    assert "channels" not in found.fragment
    plain = of_lines("{n:04d},{v:.2f},00AE")
    assert [one["numeric"] for one in plain.figures["columns"]][1] is True
