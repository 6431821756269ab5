"""``daqsvc sniff can`` on the virtual bus between processes; on interfaces of the kernel: tests/hil."""

from __future__ import annotations

import contextlib
import errno
import json
import math
import os
import re
import signal
import struct
import subprocess
import sys
import threading
import tomllib
from typing import TYPE_CHECKING, Any

import can
import numpy as np
import pytest
from support.formats import fits
from support.only_table import names_in, only_bus, only_stream
from support.paths import ROOT
from support.waiting import PATIENCE_S

from daqsvc.cli import main
from daqsvc.commands.new.interview import Given, conduct
from daqsvc.commands.new.machine_text import machine_text
from drivers.can import questions, sniff, socketcan
from drivers.can.dbc import messages_of
from drivers.can.dbc_questions import DbcQuestions
from drivers.can.dbc_traffic import MessageTraffic, SignalTraffic
from drivers.names import sensor_name
from drivers.sniffing import NothingFoundError, is_waveform_rate, sniffed
from sim_hw.bus_socket import UnixBus
from sim_hw.bus_socket_hub import Hub

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator
    from pathlib import Path

    from drivers.bus_questions import BusQuestions, Heard
    from drivers.questions import Answers, Question

pytestmark = pytest.mark.integration
DBC = ROOT / "config" / "devices" / "triaxial-accelerometer.dbc"
BEGIN = 'schema_version = 1\nsite = "lab"\nbox = "edge-1"\n\n[machine]\nname = "fan"\nspeed_rpm = 1480.0\n\n'


@pytest.fixture
def hub(tmp_path: Path) -> Iterator[Hub]:
    hub = Hub(str(tmp_path / "bus"))
    hub.start()
    try:
        yield hub
    finally:
        hub.stop()


@contextlib.contextmanager
def talking(path: Path, say: Callable[[UnixBus, int], None]) -> Iterator[None]:
    """Have somebody talk on the bus, every few milliseconds until this ends."""
    done = threading.Event()

    def talk() -> None:
        with UnixBus(str(path), fd=True, hub="join") as bus, contextlib.suppress(can.CanError):
            number = 0
            while not done.wait(0.005):
                say(bus, number)
                number += 1

    thread = threading.Thread(target=talk)
    thread.start()
    try:
        yield
    finally:
        done.set()
        thread.join()


def accelerations(bus: UnixBus, number: int) -> None:
    payload = bytes([number % 256, 0, 8, 0, 0, 0, 0xF0, 0])
    bus.send(can.Message(arbitration_id=513, is_extended_id=False, data=payload))
    bus.send(can.Message(arbitration_id=0x18FF0102, data=bytes(range(24)), is_fd=True, bitrate_switch=True))


def words(tmp_path: Path, *more: str) -> list[str]:
    return ["sniff", "can", str(tmp_path / "bus"), "--interface", "unixbus", "--fd", *more]


def figures(text: str) -> dict[str, Any]:
    found = fits("daqsvc sniff can", json.loads(text))
    assert isinstance(found, dict)
    return found


@pytest.mark.usefixtures("hub")
def test_ids_values_and_load_are_shown(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rates = ("--bitrate", "500000", "--data-bitrate", "2000000")
    with talking(tmp_path / "bus", accelerations):
        code = main(words(tmp_path, "--seconds", "0.5", "--dbc", f"{DBC}", *rates))
    said = capsys.readouterr().out
    assert code == 0
    lines = [line.split() for line in said.splitlines()]
    assert [word for word in lines[0] if word in {"load", "of", "500,000", "bit/s"}] == [
        "load",
        "of",
        "500,000",
        "bit/s",
    ]
    rows = {line[0]: " ".join(line) for line in lines if line}
    assert "11 bit 8 " in rows["0x201"]
    assert "0 " in rows["0x201"].partition(" ms ")[2]
    assert rows["0x201"].endswith("byte 0, 8 bit, +1 Acceleration")
    assert "29 bit, FD 24 " in rows["0x18FF0102"]
    assert rows["0x18FF0102"].endswith("0e 0f ... - not in the DBC file")
    assert "Acceleration AccelX 1.024 1.024 1.024 g" in said.replace("  ", " ").replace("  ", " ")
    assert "Acceleration  Sequence" in said
    assert "counts frames" in said
    assert "Heard, but not in the DBC file: 0x18FF0102" in said


@pytest.mark.usefixtures("hub")
def test_what_it_proposes_passes_check_in_a_whole_file(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with talking(tmp_path / "bus", accelerations):
        assert main(words(tmp_path, "--seconds", "0.5", "--json", "--dbc", f"{DBC}")) == 0
    found = figures(capsys.readouterr().out)
    machine = tmp_path / "machine.toml"
    machine.write_text(BEGIN + found["machine_file"])
    assert main(["check", f"{machine}"]) == 0
    said = capsys.readouterr()
    assert said.err == ""
    [stream] = tomllib.loads(found["machine_file"])["streams"].values()
    assert stream["layout"]["counter"] == {"signal": "Sequence", "counts": "frames"}
    assert [channel["name"] for channel in stream["layout"]["channels"]] == [
        *("AccelX", "AccelY", "AccelZ", "Status")
    ]
    by_id = {one["id"]: one for one in found["ids"]}
    assert stream["rate_hz"] == pytest.approx(by_id[513]["rate_hz"], rel=0.006)
    assert by_id[513]["changed_bytes"] == [0]
    assert by_id[0x18FF0102]["bit_rate_switch"] is True
    assert found["dbc"]["not_heard"] == []
    sensors = tomllib.loads(found["machine_file"])["sensors"]
    # A busy computer does not send as often as it should here.
    kind = "accelerometer" if is_waveform_rate(by_id[513]["rate_hz"]) else "trend"
    assert [(one["name"], one["type"], one["unit"]) for one in sensors] == [
        (sensor_name(name, kind, ""), kind, "g") for name in ("AccelX", "AccelY", "AccelZ")
    ]


FAN = """VERSION ""
BU_: A
BO_ 800 Vibration: 8 A
 SG_ VibDE_0 : 0|12@1- (0.01,0) [0|0] "g" A
 SG_ VibDE_1 : 12|12@1- (0.01,0) [0|0] "g" A
 SG_ TimeMs : 24|24@1+ (1,0) [0|0] "ms" A
 SG_ State : 48|4@1+ (1,0) [0|0] "" A
 SG_ Count : 56|8@1+ (1,0) [0|0] "" A
VAL_ 800 State 0 "off" 1 "on" ;
"""


def fan(bus: UnixBus, number: int) -> None:
    payload = bytes([number % 7, 0x10, 0x01]) + (3 * number).to_bytes(3, "little") + bytes([1, number % 256])
    bus.send(can.Message(arbitration_id=800, is_extended_id=False, data=payload))


@pytest.mark.usefixtures("hub")
def test_clocks_and_states_are_no_channels_and_samples_of_one_channel_are_pointed_out(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    dbc = tmp_path / "fan.dbc"
    dbc.write_text(FAN)
    with talking(tmp_path / "bus", fan):
        assert main(words(tmp_path, "--seconds", "0.5", "--json", "--dbc", f"{dbc}")) == 0
    fragment = figures(capsys.readouterr().out)["machine_file"]
    [stream] = tomllib.loads(fragment)["streams"].values()
    assert [channel["name"] for channel in stream["layout"]["channels"]] == ["VibDE_0", "VibDE_1"]
    assert stream["layout"]["counter"]["signal"] == "Count"
    assert "# TimeMs is left out: it rises all the time" in fragment
    assert (
        '# State is left out: its values have names, as states have: see "A state or an enum signal" of '
        '"Alarms" in the documentation' in fragment
    )
    assert '{ name = "VibDE", signals = ["VibDE_0", "VibDE_1"] }, and 2 times the rate' in fragment


MULTIPLEXED = """VERSION ""
BU_: A
BO_ 801 Slow: 8 A
 SG_ Page M : 0|8@1+ (1,0) [0|0] "" A
 SG_ Temperature m0 : 8|16@1- (0.1,0) [0|0] "degC" A
 SG_ Supply m1 : 8|16@1+ (0.01,0) [0|0] "V" A
"""


def test_new_offers_a_page_of_a_multiplexed_message_and_never_its_selector(tmp_path: Path) -> None:
    dbc = tmp_path / "slow.dbc"
    dbc.write_text(MULTIPLEXED)
    file = tmp_path / "new.toml"
    assert main(["new", f"{file}", "--yes", "--bus=can-dbc", f"--dbc={dbc}", "--rate=1"]) == 0
    [stream] = tomllib.loads(file.read_text("utf-8"))["streams"].values()
    assert [channel["signals"] for channel in stream["layout"]["channels"]] == [["Temperature"]]


COUNTED = (
    MULTIPLEXED.replace(" SG_ Temperature", ' SG_ Count : 24|8@1+ (1,0) [0|255] "" A\n SG_ Temperature')
    + ' SG_ Humidity m1 : 32|8@1+ (1,0) [0|0] "%" A\n'
)
"""With a counter that is on both pages, and counts the frames of both."""


def both_pages(bus: UnixBus, number: int) -> None:
    payload = bytes([number % 2, 21, 0, number % 256, 40, 0, 0, 0])
    bus.send(can.Message(arbitration_id=801, is_extended_id=False, data=payload))


@pytest.mark.usefixtures("hub")
def test_new_reads_one_page_without_the_counter_of_all_and_names_the_other(tmp_path: Path) -> None:
    dbc, file = tmp_path / "slow.dbc", tmp_path / "new.toml"
    dbc.write_text(COUNTED)
    given = ["--bus=can-dbc", "--listen", "--interface=unixbus", f"--channel={tmp_path / 'bus'}"]
    with talking(tmp_path / "bus", both_pages):
        assert main(["new", f"{file}", "--yes", *given, f"--dbc={dbc}"]) == 0
    text = file.read_text("utf-8")
    [stream] = tomllib.loads(text)["streams"].values()
    assert stream["layout"]["no_counter"]
    assert [channel["signals"] for channel in stream["layout"]["channels"]] == [["Temperature"]]
    assert "# Slow is multiplexed. For these pages make separate streams:\n" in text
    assert "#   Page 1: Supply, Humidity\n" in text


@pytest.mark.parametrize(
    ("signals", "rate"), [(("Temperature",), "10"), (("Count",), "20"), (("Supply",), "6.66667")]
)
def test_a_page_is_proposed_at_its_own_rate(tmp_path: Path, signals: tuple[str, ...], rate: str) -> None:
    (tmp_path / "slow.dbc").write_text(COUNTED)
    heard = [("Page", 100, False), ("Count", 100, False), ("Temperature", 50, True), ("Supply", 34, True)]
    found = {
        "frames": 100,
        "bitrate": None,
        "data_bitrate": None,
        "ids": [
            {"message": "Slow", "id": 0x10, "fd": False, "lengths": [8], "rate_hz": 20.0, "counter": None}
        ],
        "dbc": {
            "messages": [
                {
                    "message": "Slow",
                    "frames": 100,
                    "length_doubt": "",
                    "rate_doubt": "",
                    "signals": [
                        {
                            "signal": n,
                            "frames": f,
                            "multiplexed": m,
                            "counts_frames": n == "Count",
                            "rises": False,
                            "step": 1 if n == "Count" else None,
                            "unit": "",
                            "min": 0.0,
                            "max": 1.0,
                            "mean": 0.5,
                            "deviation": 0.3,
                            "doubt": "",
                        }
                        for n, f, m in heard
                    ],
                }
            ]
        },
    }
    answers = {"dbc-folder": tmp_path, "dbc": "slow.dbc", "message": "Slow", "signals": signals}
    proposed = DbcQuestions().heard(found, answers).proposals(answers)
    assert proposed["rate"] == rate
    assert proposed["counter"] == "none"  # what counts the frames of all pages is no counter of one


def test_signals_of_two_pages_are_not_taken_for_one_stream(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    dbc = tmp_path / "slow.dbc"
    dbc.write_text(COUNTED)
    given = ["--yes", "--bus=can-dbc", f"--dbc={dbc}", "--signals=Temperature, Supply"]
    assert main(["new", f"{tmp_path / 'new.toml'}", *given]) != 0
    assert "Supply, Temperature are on different pages: name those of one page" in capsys.readouterr().err


NESTED = """VERSION ""
BU_: X
BO_ 291 Msg: 8 X
 SG_ M0 M : 0|4@1+ (1,0) [0|15] "" X
 SG_ S m1M : 4|4@1+ (1,0) [0|15] "" X
 SG_ A m0 : 8|16@1- (0.1,0) [0|0] "V" X
 SG_ C m1 : 8|8@1- (0.1,0) [0|0] "V" X
 SG_ B m0 : 16|16@1- (0.1,0) [0|0] "A" X
 SG_ B2 m2 : 32|16@1- (0.1,0) [0|0] "A" X
SG_MUL_VAL_ 291 S M0 1-1;
SG_MUL_VAL_ 291 A M0 0-0;
SG_MUL_VAL_ 291 C M0 1-1;
SG_MUL_VAL_ 291 B S 0-0;
SG_MUL_VAL_ 291 B2 S 2-2;
BO_ 292 Wide: 8 X
 SG_ P M : 0|8@1+ (1,0) [0|255] "" X
 SG_ V m0 : 16|16@1- (0.1,0) [0|0] "V" X
 SG_ W m0 : 32|16@1- (0.1,0) [0|0] "V" X
SG_MUL_VAL_ 292 V P 0-199;
SG_MUL_VAL_ 292 W P 0-49;
"""
"""Pages within a page, and signals on many pages."""


@pytest.mark.parametrize(
    ("more", "channels", "rate_hz"),
    [
        (["--message=Msg"], ["A"], 500.0),
        (["--message=Msg", "--signals=C, B"], ["C", "B"], 250.0),
        (["--message=Msg", "--signals=C"], ["C"], 500.0),
        (["--message=Wide"], ["V", "W"], 250.0),
        (["--message=Wide", "--signals=V"], ["V"], 1000.0),
    ],
)
def test_new_reads_signals_that_come_in_one_frame_at_their_share_of_the_frames(
    tmp_path: Path, more: list[str], channels: list[str], rate_hz: float
) -> None:
    dbc, file = tmp_path / "nested.dbc", tmp_path / "new.toml"
    dbc.write_text(NESTED)
    assert main(["new", f"{file}", "--yes", "--bus=can-dbc", f"--dbc={dbc}", *more]) == 0
    [stream] = tomllib.loads(file.read_text("utf-8"))["streams"].values()
    assert [channel["name"] for channel in stream["layout"]["channels"]] == channels
    assert stream["rate_hz"] == rate_hz
    assert main(["check", f"{file}"]) == 0


def test_a_counter_of_all_pages_is_warned_of(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    dbc, file = tmp_path / "slow.dbc", tmp_path / "new.toml"
    dbc.write_text(COUNTED)
    assert main(["new", f"{file}", "--yes", "--bus=can-dbc", f"--dbc={dbc}", "--counter=Count"]) == 0
    capsys.readouterr()
    assert main(["check", f"{file}"]) == 0
    assert 'is on more pages of message "Slow"' in " ".join(capsys.readouterr().out.split())


def test_new_points_out_signals_that_may_be_samples_of_one_channel(tmp_path: Path) -> None:
    dbc, file = tmp_path / "fan.dbc", tmp_path / "new.toml"
    dbc.write_text(FAN)
    assert main(["new", f"{file}", "--yes", "--bus=can-dbc", f"--dbc={dbc}", "--consecutive=no"]) == 0
    one = '{ name = "VibDE", signals = ["VibDE_0", "VibDE_1"] }, and 2 times the rate'
    assert f"# If these are samples of one channel: {one}" in file.read_text("utf-8")


def test_new_writes_the_names_of_a_state_beside_its_channel(tmp_path: Path) -> None:
    dbc, file = tmp_path / "fan.dbc", tmp_path / "new.toml"
    dbc.write_text(FAN)
    command = ["new", f"{file}", "--yes", "--bus=can-dbc", f"--dbc={dbc}", "--message=Vibration"]
    assert main([*command, "--signals=VibDE_0, State"]) == 0
    assert '# State is a state: 0 "off", 1 "on"' in file.read_text("utf-8")


@pytest.mark.usefixtures("hub")
def test_without_a_dbc_file_the_proposal_has_the_bus_and_says_what_is_missing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with talking(tmp_path / "bus", accelerations):
        assert main(words(tmp_path, "--seconds", "0.5", "--bitrate", "250000", "--json")) == 0
    fragment = figures(capsys.readouterr().out)["machine_file"]
    assert tomllib.loads(fragment) == {
        "buses": {
            "bus": {
                "driver": "can",
                "interface": "unixbus",
                "channel": str(tmp_path / "bus"),
                "fd": True,
                "bitrate": 250_000,
            }
        }
    }
    whole = (ROOT / "config" / "machines" / "virtual-rig.toml").read_text()
    table = whole[whole.index("[buses.can0]") : whole.index("[streams.shaft]")]
    machine = tmp_path / "machine.toml"
    machine.write_text(whole.replace(table, fragment + "\n\n").replace('bus = "can0"', 'bus = "bus"'))
    assert main(["check", f"{machine}"]) == 0
    assert capsys.readouterr().err == ""
    assert "#   0x201: 8 bytes, " in fragment
    assert "bytes 0 change, counter at byte 0, 8 bit, +1" in fragment
    assert "always the same" in fragment


@pytest.mark.usefixtures("hub")
def test_a_silent_bus_is_a_failure_that_says_what_to_check(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(words(tmp_path, "--seconds", "0.1")) == 1
    said = capsys.readouterr()
    assert re.search(r": 0 frames in \d\.\d s", said.out)  # longer where the computer is slow
    assert "To begin a machine file" not in said.out
    assert re.search(r"no frame in \d\.\d s\. Remedy: start the program that sends there", said.err)
    assert "ip link" not in said.err


def test_a_bus_that_is_lost_ends_it_and_what_was_heard_is_shown(
    hub: Hub, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def say(bus: UnixBus, number: int) -> None:
        accelerations(bus, number)
        if number == 100:
            threading.Thread(target=hub.stop).start()

    with talking(tmp_path / "bus", say):
        assert main(words(tmp_path, "--seconds", "60")) == 1
    said = capsys.readouterr()
    assert "0x201" in said.out
    assert "was lost after" in said.err


@pytest.mark.usefixtures("hub")
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_ctrl_c_ends_it_early_and_shows_what_was_heard(tmp_path: Path, number: signal.Signals) -> None:
    command = [sys.executable, "-m", "daqsvc", *words(tmp_path, "--seconds", "600", "--json")]
    with talking(tmp_path / "bus", accelerations):
        process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        try:
            assert process.stderr is not None
            assert process.stderr.readline().startswith("listening to ")
            threading.Event().wait(0.3)  # time for some frames
            process.send_signal(number)
            output, said = process.communicate(timeout=PATIENCE_S)
        finally:
            process.kill()
            process.communicate()
    assert (process.returncode, said) == (0, "")
    assert {one["id"] for one in figures(output)["ids"]} == {513, 0x18FF0102}


@pytest.mark.parametrize(
    ("number", "words"),
    [
        (
            errno.ENODEV,
            "there is no CAN interface can7 (CAN interfaces of this computer: can0, vcan3). Remedy: plug",
        ),
        (errno.ENETDOWN, "can7 is down. Remedy: ip link set can7 up type can bitrate 500000"),
    ],
)
def test_an_interface_that_is_not_there_or_down_is_one_line_with_the_remedy(
    number: int,
    words: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise OSError(number, os.strerror(number))

    for name, kind in (("lo", 772), ("can0", 280), ("vcan3", 280)):
        (tmp_path / name).mkdir()
        (tmp_path / name / "type").write_text(f"{kind}\n")
    monkeypatch.setattr(sniff, "_NETWORK", tmp_path)
    monkeypatch.setattr(socketcan, "open_socketcan", refuse)
    assert main(["sniff", "can", "can7"]) == 1
    said = capsys.readouterr()
    assert said.out == ""
    assert words in said.err
    assert len(said.err.splitlines()) == 1


def test_bit_rates_of_the_kernel_are_read_where_there_are_some(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    shown = {"info_data": {"bittiming": {"bitrate": 250_000}, "data_bittiming": {"bitrate": 2_000_000}}}
    program = tmp_path / "ip"
    program.write_text(f"#!/bin/sh\ncat <<'END'\n{json.dumps([{'linkinfo': shown}])}\nEND\n")
    program.chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:{os.environ['PATH']}")
    assert sniff._kernel_facts("can0") == (250_000, 2_000_000)
    program.write_text("#!/bin/sh\nexit 1\n")
    assert sniff._kernel_facts("can0") == (None, None)
    monkeypatch.setenv("PATH", f"{tmp_path / 'nowhere'}")
    assert sniff._kernel_facts("can0") == (None, None)


@pytest.mark.parametrize(
    ("more", "words"),
    [
        (("--seconds", "0"), "--seconds 0: give a time above 0"),
        (("--seconds", "nan"), "--seconds nan: give a time above 0"),
        (("--bitrate", "5"), "--bitrate 5: "),
        (("--dbc", "absent.dbc"), "--dbc: there is no file"),
        (("--interface", "peek"), "--interface peek: python-can knows no such interface. Remedy: "),
    ],
)
def test_wrong_arguments_are_one_line(
    more: tuple[str, str], words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["sniff", "can", "can7", *more]) == 2
    said = capsys.readouterr().err
    assert words in said
    assert len(said.splitlines()) == 1


def packed(bus: UnixBus, number: int) -> None:
    """Two samples of two channels, behind a counter of samples."""
    payload = (2 * number % 65_536).to_bytes(2, "big") + bytes(range(8)) + bytes([number % 251, 0])
    bus.send(can.Message(arbitration_id=0x2A1, is_extended_id=False, data=payload, is_fd=True))
    if number % 3 == 0:
        bus.send(can.Message(arbitration_id=0x80, is_extended_id=False, data=b"\x01"))


def new(tmp_path: Path, *more: str) -> dict[str, Any]:
    """The machine file of `daqsvc new --listen`, which check has accepted."""
    file = tmp_path / "new.toml"
    words = ["--listen", "--interface=unixbus", f"--channel={tmp_path / 'bus'}", "--overwrite", *more]
    assert main(["new", f"{file}", "--yes", *words]) == 0
    return tomllib.loads(file.read_text("utf-8"))


def comments(file: Path) -> str:
    """The comments in front of all tables, as one line: long sentences are in several."""
    head = file.read_text("utf-8").partition("\nschema_version")[0]
    return " ".join(" ".join(line.removeprefix("#") for line in head.splitlines()).split())


def not_written(tmp_path: Path, *more: str) -> int:
    """The exit code of the same where it writes no file."""
    file = tmp_path / "new.toml"
    words = ["--listen", "--interface=unixbus", f"--channel={tmp_path / 'bus'}", *more]
    code = main(["new", f"{file}", "--yes", *words])
    assert not file.exists()
    return code


@pytest.mark.usefixtures("hub")
def test_a_bus_with_few_frames_is_listened_to_longer(tmp_path: Path) -> None:
    def rare(bus: UnixBus, number: int) -> None:
        if number % 60 == 0:
            accelerations(bus, number)

    told: list[str] = []
    where = ["--interface", "unixbus", "--fd", f"{tmp_path / 'bus'}"]
    with talking(tmp_path / "bus", rare):
        longer = sniffed(sniff.CanSniffer(0.5), where, threading.Event(), told.append)
        with contextlib.suppress(NothingFoundError):  # on a busy computer none may come in so short a time
            sniffed(sniff.CanSniffer(0.5), [*where, "--seconds", "0.5"], threading.Event(), told.append)
    assert min(one["frames"] for one in longer["ids"]) >= 2
    assert [line.partition(" for up to")[0] for line in told] == [
        f"listening to {tmp_path / 'bus'} for 0.5 s; Ctrl-C ends it early",
        "too few frames came in 0.5 s to judge their rates: listening",
        f"listening to {tmp_path / 'bus'} for 0.5 s; Ctrl-C ends it early",
    ]


@pytest.mark.long
@pytest.mark.usefixtures("hub")
def test_new_proposes_the_frames_that_it_hears(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(questions, "_LISTEN_S", 3.0)
    with talking(tmp_path / "bus", packed):
        tables = new(tmp_path, "--bus=can", "--channels=c1, c2", "--raw-type=int16", "--scale=0.1")
        said = capsys.readouterr().out
        one = ["--id=0x80", "--channels=state", "--raw-type=uint8", "--scale=1"]
        other = new(tmp_path, "--bus=can", *one)
    assert "0x2a1: 12 bytes" in said
    assert only_bus(tables)["fd"] is True
    layout = only_stream(tables)["layout"]
    assert (layout["id"], layout["length"], layout["samples_per_frame"]) == (0x2A1, 12, 2)
    assert layout["counter"] == {"byte": 0, "bits": 16, "counts": "samples"}
    assert (layout["byte_order"], layout["first_byte"]) == ("big", 2)
    assert len(layout["channels"]) == 2
    # Of another id than the one that is proposed, what was heard of that.
    layout = only_stream(other)["layout"]
    assert (layout["length"], layout["no_counter"], layout["samples_per_frame"]) == (1, True, 1)
    assert only_stream(other)["rate_hz"] < only_stream(tables)["rate_hz"] / 2


@pytest.mark.usefixtures("hub")
def test_new_writes_nothing_where_nothing_states_what_the_bytes_of_a_frame_mean(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(questions, "_LISTEN_S", 0.5)
    with talking(tmp_path / "bus", accelerations):
        assert not_written(tmp_path, "--bus=can") == 1
        said = capsys.readouterr().err
        assert not_written(tmp_path, "--bus=can", "--channels=a, b", "--raw-type=int16") == 1
    assert "nothing was written: no frame states which of its bytes are which value. Heard: 0x" in said
    assert "0x201: 8 bytes, 1" in said
    assert "Remedy: give the DBC file of the device, with --bus can-dbc --dbc; or give --channels" in said
    assert said.count("\n") == 1
    assert "no frame states which of its bytes" in capsys.readouterr().err  # what a count is worth


@pytest.mark.usefixtures("hub")
def test_new_states_what_of_a_layout_was_neither_heard_nor_answered(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(questions, "_LISTEN_S", 0.5)
    layout = ["--id=0x201", "--channels=a, b", "--raw-type=int16", "--scale=0.1"]
    with talking(tmp_path / "bus", accelerations):
        new(tmp_path, "--bus=can", *layout)
        said = capsys.readouterr().out
        text = comments(tmp_path / "new.toml")
        more = ["--byte-order=big", "--first-byte=1", "--sensor=a.type=trend", "--sensor=b.type=trend"]
        new(tmp_path, "--bus=can", *layout, *more)
    words = (
        "Neither heard nor answered: the byte where samples begin, 1 (--first-byte); the byte order, little "
        "(--byte-order); which sensors are on a, b (--sensor a.type=). See the device's manual."
    )
    assert words in text
    assert f"\n{words}\n" in said
    assert "Neither heard" not in capsys.readouterr().out  # whoever states the layout knows it


@pytest.mark.usefixtures("hub")
def test_a_person_who_takes_all_defaults_is_told_that_the_channels_are_an_example(tmp_path: Path) -> None:
    given = {"bus": "can", "interface": "unixbus", "channel": f"{tmp_path / 'bus'}", "id": "0x201"}

    def listen(bus: BusQuestions, answers: Answers) -> Heard:
        return bus.listen(answers, tmp_path, threading.Event(), print)

    def notes(**more: str) -> list[str]:
        texts = Given(given | more, defaults=False)
        file = tmp_path / "new.toml"
        answers = conduct(file, texts, lambda _question: "", print, listen)
        return list(answers["notes"])

    with pytest.MonkeyPatch.context() as patch, talking(tmp_path / "bus", accelerations):
        patch.setattr(questions, "_LISTEN_S", 0.5)
        example = "The bytes of 0x201 are not known: these channels are an example."
        assert example in notes()
        assert example not in notes(channels="a, b")


def test_new_that_does_not_listen_states_that_its_frames_are_an_example(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "new.toml"
    assert main(["new", f"{file}", "--yes", "--bus=can"]) == 0
    words = (
        "The frames are an example: nothing was heard, and nobody has stated what the bytes of 0x101 mean."
    )
    assert f"\n{words}" in capsys.readouterr().out
    assert words in comments(file)
    known = ["--id=0x101", "--channels=a, b", "--raw-type=int16", "--scale=0.1", "--overwrite"]
    assert main(["new", f"{file}", "--yes", "--bus=can", *known]) == 0
    assert "an example" not in capsys.readouterr().out


@pytest.mark.usefixtures("hub")
def test_new_proposes_the_message_that_comes(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(questions, "_LISTEN_S", 0.5)
    with talking(tmp_path / "bus", accelerations):
        tables = new(tmp_path, "--bus=can-dbc", f"--dbc={DBC}")
    said = capsys.readouterr().out
    assert ", Acceleration\n" in said
    assert ", not in the DBC file\n" in said
    assert "another device" not in said
    layout = only_stream(tables)["layout"]
    assert layout["message"] == "Acceleration"
    assert layout["counter"] == {"signal": "Sequence", "counts": "frames"}
    assert 50 < only_stream(tables)["rate_hz"] < 300


@pytest.mark.usefixtures("hub")
def test_new_says_that_the_dbc_file_is_of_another_device(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(questions, "_LISTEN_S", 0.5)
    (tmp_path / "other.dbc").write_text(COUNTED)
    with talking(tmp_path / "bus", accelerations):
        assert not_written(tmp_path, "--bus=can-dbc", "--dbc=other.dbc") == 1
    said = capsys.readouterr()
    assert said.out.count(", not in the DBC file\n") == 2
    assert (
        "nothing was written: No frame is as other.dbc describes: it is most likely the file of" in said.err
    )
    assert "Remedy: give the file of the device that sends [C20]" in said.err
    assert "\n  Found:\n" in said.out
    assert "Found, and proposed" not in said.out


@pytest.mark.usefixtures("hub")
@pytest.mark.parametrize("silent", [True, False])
def test_who_goes_on_with_a_dbc_file_that_was_not_heard_is_told_what_is_assumed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, *, silent: bool
) -> None:
    monkeypatch.setattr(questions, "_LISTEN_S", 0.3)
    (tmp_path / "other.dbc").write_text(
        'VERSION ""\nBU_: A\nBO_ 900 Motor: 8 A\n SG_ Zaehler : 0|8@1+ (1,0) [0|255] "" A\n'
        ' SG_ Lager : 8|16@1+ (0.1,-40) [-40|215] "degC" A\n'
    )
    given = {"bus": "can-dbc", "interface": "unixbus", "channel": f"{tmp_path / 'bus'}", "dbc": "other.dbc"}

    def listen(bus: BusQuestions, answers: Answers) -> Heard | None:
        return None if silent else bus.listen(answers, tmp_path, threading.Event(), print)

    with talking(tmp_path / "bus", accelerations):
        file = tmp_path / "new.toml"
        answers = conduct(file, Given(given, defaults=False), lambda _question: "", print, listen)
    file.write_text(machine_text(answers, file.name))
    begin = (
        "Nothing was heard on the bus; the" if silent else "None of these channels was heard on the bus; they"
    )
    text = comments(file)
    assert f"{begin} {'channels ' * silent}are as other.dbc describes them." in text
    assert ("it is most likely the file of another device." in text) == (not silent)
    assert "Assumed, as nobody has stated it: speed_rpm, bitrate, rate_hz, counter" in text
    lines = file.read_text("utf-8").splitlines()
    for key in ("rate_hz", "counter", "bitrate", "speed_rpm"):
        assert any(line.startswith(f"{key} = ") and "# assumed" in line for line in lines), key


@pytest.mark.usefixtures("hub")
@pytest.mark.parametrize(
    ("given", "words"),
    [
        (("--bus=can", "--id=0x7f0"), "0x7f0 was not heard. Remedy: correct --id; those that come: 0x"),
        (
            ("--bus=can-dbc", "--dbc=two.dbc", "--message=Environment"),
            "Environment was not heard. Remedy: correct --message; those that come: Acceleration",
        ),
        (
            ("--bus=can-dbc", "--dbc=short.dbc"),
            "frames of Acceleration have more than the 6 bytes of the DBC file, and a stream does not read",
        ),
    ],
)
def test_new_writes_nothing_about_frames_that_it_did_not_hear(
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    given: tuple[str, ...],
    words: str,
) -> None:
    monkeypatch.setattr(questions, "_LISTEN_S", 0.5)
    other = '\nBO_ 1000 Environment: 8 Vector__XXX\n SG_ Humidity : 0|16@1+ (0.1,0) [0|100] "%" Vector__XXX\n'
    (tmp_path / "two.dbc").write_text(DBC.read_text("utf-8") + other)
    message = DBC.read_text("utf-8").replace("Acceleration: 8", "Acceleration: 6")
    kept = [one for one in message.splitlines() if "AccelZ" not in one and "Status" not in one]
    (tmp_path / "short.dbc").write_text("\n".join([*kept, ""]))
    with talking(tmp_path / "bus", accelerations):
        assert not_written(tmp_path, *given) == 1
    assert words in capsys.readouterr().err


@pytest.mark.usefixtures("hub")
def test_new_names_the_messages_that_it_heard_and_does_not_read(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(questions, "_LISTEN_S", 0.5)
    (tmp_path / "two.dbc").write_text(
        DBC.read_text("utf-8")
        + '\nBO_ 801 Slow: 8 Vector__XXX\n SG_ T : 0|16@1+ (0.1,0) [0|0] "degC" A\n'
        + '\nVAL_ 513 Status 0 "good" 1 "self-test failed" ;\n'
    )

    def both(bus: UnixBus, number: int) -> None:
        accelerations(bus, number)
        bus.send(can.Message(arbitration_id=801, is_extended_id=False, data=bytes(8)))

    with talking(tmp_path / "bus", both):
        new(tmp_path, "--bus=can-dbc", "--dbc=two.dbc", "--message=Acceleration")
    command = f"daqsvc sniff can {tmp_path / 'bus'} --interface unixbus --dbc two.dbc"
    note = (
        f"Not read: Slow (0x321); {command} prints their tables. Of these take the streams and sensors: "
        "they are on the same bus."
    )
    state = "Status is left out: its values have names, as states have: see"
    assert f"\n{note}\n{state}" in capsys.readouterr().out
    assert f"{note} {state}" in comments(tmp_path / "new.toml")


@pytest.mark.usefixtures("hub")
def test_a_message_that_comes_from_another_source_address_is_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(questions, "_LISTEN_S", 0.3)
    text = f'VERSION ""\nBU_: N\nBO_ {0x98FEF2FE} Engine: 8 N\n SG_ T : 0|16@1+ (0.1,0) [0|0] "degC" N\n'
    (tmp_path / "engine.dbc").write_text(text)

    def engine(bus: UnixBus, number: int) -> None:
        bus.send(can.Message(arbitration_id=0x18FEF221, data=bytes([number % 256, *bytes(7)])))

    said = (
        "0x18FEF221 is Engine from the source address 0x21; in the DBC file it has 0xFE (SAE J1939). Remedy: "
    )
    remedy = f"in a copy of the DBC file write BO_ {0x98FEF221} in place of BO_ {0x98FEF2FE}"
    with talking(tmp_path / "bus", engine):
        assert main(words(tmp_path, "--seconds", "0.3", "--dbc", f"{tmp_path / 'engine.dbc'}")) == 0
        assert f"{said}{remedy}." in capsys.readouterr().out
        assert not_written(tmp_path, "--bus=can-dbc", "--dbc=engine.dbc") == 1
        assert f"{said}{remedy}" in capsys.readouterr().err
        (tmp_path / "engine.dbc").write_text(text.replace(f"{0x98FEF2FE}", f"{0x98FEF221}"))
        assert new(tmp_path, "--bus=can-dbc", "--dbc=engine.dbc")["sensors"][0]["channel"] == "T"


@pytest.mark.usefixtures("hub")
def test_new_leaves_a_clock_out_as_sniff_does(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(questions, "_LISTEN_S", 0.5)
    text = FAN.replace("TimeMs", "Tick").replace("VibDE_0", "Ax").replace("VibDE_1", "Ay")
    (tmp_path / "fan.dbc").write_text(text)
    with talking(tmp_path / "bus", fan):
        found = new(tmp_path, "--bus=can-dbc", "--dbc=fan.dbc")
    assert [one["channel"] for one in found["sensors"]] == ["Ax", "Ay"]
    assert "Tick is left out: it rises all the time, as a clock does." in capsys.readouterr().out
    assert "Tick is left out: it rises all the time, as a clock does." in comments(tmp_path / "new.toml")


STATUS = """VERSION ""
BU_: A
BO_ 802 Temps: 6 A
 SG_ OilTemp : 0|16@1- (0.1,0) [-40|200] "degC" A
 SG_ Flow : 16|16@1+ (0.1,0) [0|0] "l/min" A
 SG_ StatusCount : 32|16@1+ (1,0) [0|0] "" A
"""
"""With a status word that is named as a counter, and no counter."""


def temperatures(bus: UnixBus, number: int) -> None:
    status = 0x8004 if number % 40 > 30 else 4
    payload = b"".join(v.to_bytes(2, "little") for v in (610 + number % 20, 450, status))
    bus.send(can.Message(arbitration_id=802, is_extended_id=False, data=payload))


@pytest.mark.usefixtures("hub")
def test_new_takes_no_signal_for_the_counter_that_was_not_heard_to_count(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(questions, "_LISTEN_S", 0.5)
    (tmp_path / "temps.dbc").write_text(STATUS)
    given = ["--bus=can-dbc", "--dbc=temps.dbc"]
    with talking(tmp_path / "bus", temperatures):
        tables = new(tmp_path, *given, "--rate=200")
        said = capsys.readouterr().out
        (tmp_path / "new.toml").unlink()
        assert not_written(tmp_path, *given, "--counter=StatusCount") == 1
    assert only_stream(tables)["layout"]["no_counter"] is True
    assert [one["unit"] for one in tables["sensors"]] == ["degC", "l/min"]
    text = (
        "Heard: OilTemp 61 to 62.9 degC; Flow 45 l/min.\n"
        "No signal is known to count the frames of Temps: lost ones are found by the times of arrival only.\n"
        "Not read of Temps: StatusCount. Name with --signals what of them is measured.\n"
    )
    assert f"\n{text}" in said
    assert "StatusCount does not grow by 1 from frame to frame. Remedy: correct" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("counts", "is_counter"),
    [
        (range(600), True),
        ([n for n in range(600) if n not in {77, 300, 301}], True),  # frames that were lost meanwhile
        ([n for n in range(600) if n % 9], False),
        ([n % 100 for n in range(600)], False),  # each turn would count as a loss
        ([n % 255 + 1 for n in range(600)], False),
        (range(8), False),
    ],
)
def test_a_counter_of_a_dbc_file_may_miss_a_few_frames_and_no_value(
    tmp_path: Path, counts: Iterable[int], *, is_counter: bool
) -> None:
    (tmp_path / "x.dbc").write_text('VERSION ""\nBU_: A\nBO_ 1 M: 1 A\n SG_ C : 0|8@1+ (1,0) [0|0] "" A\n')
    [message] = messages_of(tmp_path / "x.dbc")
    signal = SignalTraffic(message, message.signals[0])
    payloads = (np.array(list(counts)) % 256).astype(np.uint8)[:, None]
    for piece in np.array_split(payloads, max(len(payloads) // 50, 1)):
        signal.take(piece)
    assert signal.counts == is_counter


@pytest.mark.usefixtures("hub")
def test_new_states_that_too_few_frames_came_to_see_a_counter(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(questions, "_LISTEN_S", 1.0)
    (tmp_path / "temps.dbc").write_text(STATUS)

    def seldom(bus: UnixBus, number: int) -> None:
        if number % 40 == 0:
            temperatures(bus, number)

    with talking(tmp_path / "bus", seldom):
        new(tmp_path, "--bus=can-dbc", "--dbc=temps.dbc", "--rate=5")
    words = (
        "Too few frames of Temps came to see whether StatusCount counts them: without --counter StatusCount"
    )
    assert words in capsys.readouterr().out


@pytest.mark.usefixtures("hub")
def test_a_signal_that_does_not_count_is_not_offered_to_a_person_as_the_counter(tmp_path: Path) -> None:
    (tmp_path / "temps.dbc").write_text(STATUS.replace("StatusCount", "StatusWord"))
    shown: dict[str, Question] = {}

    def ask(question: Question) -> str:
        shown[question.key] = question
        return question.default or ""

    given = {
        "bus": "can-dbc",
        "interface": "unixbus",
        "channel": f"{tmp_path / 'bus'}",
        "dbc": "temps.dbc",
        "rate": "200",
    }

    def listen(bus: BusQuestions, answers: Answers) -> Heard:
        return bus.listen(answers, tmp_path, threading.Event(), print)

    with pytest.MonkeyPatch.context() as patch, talking(tmp_path / "bus", temperatures):
        patch.setattr(questions, "_LISTEN_S", 0.5)
        conduct(tmp_path / "new.toml", Given(given, defaults=False), ask, print, listen)
    assert shown["counter"].default == "none"
    assert list(shown["counter"].choices or {}) == ["none"]


@pytest.mark.usefixtures("hub")
def test_values_that_the_dbc_file_excludes_are_stated_as_a_doubt_about_the_file(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A file of another device whose frames have the same id and length; nothing is certain here."""
    monkeypatch.setattr(questions, "_LISTEN_S", 0.5)
    (tmp_path / "other.dbc").write_text(
        'VERSION ""\nBU_: A\nBO_ 513 Pump: 8 A\n SG_ Cnt : 0|8@1+ (1,0) [0|255] "" A\n'
        ' SG_ Pressure : 8|16@1+ (0.01,0) [0|100] "bar" A\n SG_ Flow : 24|16@1+ (0.1,0) [0|0] "l/min" A\n'
        ' SG_ Level : 40|8@1+ (1,0) [0|0] "%" A\n'
    )

    def vibration(bus: UnixBus, number: int) -> None:
        x, y = (-20 if number % 2 else 20), (-1 if number % 3 else 1)
        payload = bytes([number % 256]) + x.to_bytes(2, "little", signed=True)
        payload += y.to_bytes(2, "little", signed=True) + bytes(3)
        bus.send(can.Message(arbitration_id=513, is_extended_id=False, data=payload))

    with talking(tmp_path / "bus", vibration):
        assert not_written(tmp_path, "--bus=can-dbc", "--dbc=other.dbc") == 1
        listened = capsys.readouterr()
        new(tmp_path, "--bus=can-dbc", "--dbc=other.dbc", "--signals=Level")
        in_terminal = capsys.readouterr().out
        assert main(words(tmp_path, "--seconds", "0.5", "--dbc", f"{tmp_path / 'other.dbc'}")) == 0
        shown = capsys.readouterr().out
        assert main(words(tmp_path, "--seconds", "0.5", "--json", "--dbc", f"{tmp_path / 'other.dbc'}")) == 0
    [message] = figures(capsys.readouterr().out)["dbc"]["messages"]
    range_of = {one["signal"]: (one["dbc_min"], one["dbc_max"]) for one in message["signals"]}
    assert range_of == {"Cnt": (0, 255), "Pressure": (0, 100), "Flow": (None, None), "Level": (None, None)}
    assert "nothing was written: Pressure reads 0.2 to 655.16 bar, in " in listened.err
    assert (
        "Remedy: give the file of the device that sends. If it is that one, name with --signals"
        in listened.err
    )
    # Who names other signals has the doubt in the file and behind all, too: it is about the file.
    assert "Pressure reads" in in_terminal.partition("is written;")[2]
    for text in (listened.out, comments(tmp_path / "new.toml"), shown):
        assert "Pressure reads 0.2 to 655.16 bar, in " in text
        assert "beyond what the DBC file states (0 to 100): is it the file of this device?" in text
        assert "Flow jumps by more than half of what its 16 bits can carry, in " in text
    assert "# Pressure reads 0.2 to 655.16 bar, in " in shown  # the tables to begin a machine file with


@pytest.mark.usefixtures("hub")
def test_new_says_what_to_do_when_no_frame_comes(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(questions, "_LISTEN_S", 0.2)
    assert not_written(tmp_path, "--bus=can") == 1
    said = capsys.readouterr().err
    assert said.startswith("daqsvc new: nothing was written: ")
    assert "Remedy: start the program that sends there" in said


def test_the_path_of_a_bus_between_programs_is_known_as_one(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["sniff", "can", "/nowhere/bus"]) == 1
    assert "for the path of a bus between programs write --interface unixbus" in capsys.readouterr().err


SEVERITY = """VERSION ""
BU_: A
BO_ 700 Fast: 4 A
 SG_ Cnt : 0|8@1+ (1,0) [0|0] "" A
 SG_ Severity : 8|16@1- (0.01,0) [0|0] "mm/s" A
"""


def severity(bus: UnixBus, number: int) -> None:
    value = 158 + number % 4
    payload = bytes([number % 256]) + value.to_bytes(2, "little", signed=True) + b"\0"
    bus.send(can.Message(arbitration_id=700, is_extended_id=False, data=payload))


@pytest.mark.usefixtures("hub")
def test_sniff_and_new_take_a_velocity_that_keeps_off_0_for_a_level(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(questions, "_LISTEN_S", 0.5)
    (tmp_path / "s.dbc").write_text(SEVERITY)
    with talking(tmp_path / "bus", severity):
        assert main(words(tmp_path, "--seconds", "0.5", "--dbc", f"{tmp_path / 's.dbc'}")) == 0
        proposed = capsys.readouterr().out
        [sensor] = new(tmp_path, "--bus=can-dbc", "--dbc=s.dbc", "--rate=200")["sensors"]
    assert 'type = "trend"' in proposed
    assert 'type = "velocity"' not in proposed
    assert (sensor["type"], sensor["unit"]) == ("trend", "mm/s")


WAVE = """VERSION ""
BU_: A
BO_ 417 Wave: 8 A
 SG_ WaveSeq : 7|16@0+ (1,0) [0|65535] "" A
 SG_ AccHor_0 : 23|12@0- (0.01,0) [-20|20] "g" A
 SG_ AccHor_1 : 27|12@0- (0.01,0) [-20|20] "g" A
 SG_ Temp : 47|8@0- (1,0) [-40|120] "degC" A
 SG_ Tick : 55|8@0+ (1,0) [0|255] "" A
"""
"""A counter of samples, two of which are in a frame, beside a temperature and a clock."""


def wave(bus: UnixBus, number: int) -> None:
    payload = (2 * number % 65_536).to_bytes(2, "big") + bytes([(number * 5) % 20, number % 3, 1, 40])
    bus.send(
        can.Message(arbitration_id=417, is_extended_id=False, data=payload + bytes([5 * number % 256, 0]))
    )


@pytest.mark.usefixtures("hub")
def test_a_counter_of_samples_is_found_and_shows_which_signals_are_samples(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(questions, "_LISTEN_S", 0.5)
    (tmp_path / "wave.dbc").write_text(WAVE)
    with talking(tmp_path / "bus", wave):
        assert main(words(tmp_path, "--seconds", "0.5", "--json", "--dbc", f"{tmp_path / 'wave.dbc'}")) == 0
        found = figures(capsys.readouterr().out)
        assert main(words(tmp_path, "--seconds", "0.5", "--dbc", f"{tmp_path / 'wave.dbc'}")) == 0
        shown = capsys.readouterr().out
        written = new(tmp_path, "--bus=can-dbc", "--dbc=wave.dbc", "--rate=400")
        said = capsys.readouterr().out
        (tmp_path / "new.toml").unlink()
        given = ("--bus=can-dbc", "--dbc=wave.dbc", "--rate=400", "--counter=Tick")
        assert not_written(tmp_path, *given) == 1
    machine = tmp_path / "machine.toml"
    machine.write_text(BEGIN + found["machine_file"])
    assert main(["check", f"{machine}"]) == 0
    assert names_in(written) == names_in(tomllib.loads(found["machine_file"]))
    assert names_in(written) == {("bus", "Wave", "accel-AccHor")}
    [proposed] = tomllib.loads(found["machine_file"])["streams"].values()
    for layout in (proposed["layout"], only_stream(written)["layout"]):
        assert layout["counter"] == {"signal": "WaveSeq", "counts": "samples"}
        assert layout["channels"] == [{"name": "AccHor", "signals": ["AccHor_0", "AccHor_1"]}]
    frames_hz = next(one["rate_hz"] for one in found["ids"] if one["id"] == 417)
    assert proposed["rate_hz"] == pytest.approx(2 * frames_hz, rel=0.01)
    assert "grows by 2 with each frame" in shown
    assert "# Tick is left out: it rises all the time, as a clock does" in shown
    assert "# Temp is left out: it comes once a frame, the channels have 2 samples in it" in shown
    assert "Temp" in said.partition("Not read")[2]
    assert "Tick grows by 5 and not by 1 from frame to frame. Remedy: correct" in capsys.readouterr().err


BEARINGS = """VERSION ""
BU_: A
BO_ 810 Beschl: 8 A
 SG_ Beschl_0 : 0|16@1- (0.001,0) [0|0] "g" A
 SG_ Beschl_1 : 16|16@1- (0.001,0) [0|0] "g" A
 SG_ Beschl_2 : 32|16@1- (0.001,0) [0|0] "g" A
 SG_ Count : 48|8@1+ (1,0) [0|0] "" A
"""
"""Numbered signals of vibration: by their names samples of one channel, or separate sensors."""


def vibrating(*amplitudes_g: float) -> Callable[[UnixBus, int], None]:
    def send(bus: UnixBus, number: int) -> None:
        parts = [round(1000 * each * math.sin(1.7 * number + k)) for k, each in enumerate(amplitudes_g)]
        payload = struct.pack("<3hBB", *parts, number % 256, 0)
        bus.send(can.Message(arbitration_id=810, is_extended_id=False, data=payload))

    return send


@pytest.mark.usefixtures("hub")
@pytest.mark.parametrize(
    ("levels", "channels"),
    [((0.4, 0.4, 0.4), ["Beschl"]), ((0.08, 0.42, 1.2), ["Beschl_0", "Beschl_1", "Beschl_2"])],
)
def test_numbered_signals_of_different_levels_are_separate_sensors_and_else_a_guess(
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    levels: tuple[float, ...],
    channels: list[str],
) -> None:
    monkeypatch.setattr(questions, "_LISTEN_S", 0.5)
    (tmp_path / "b.dbc").write_text(BEARINGS)
    with talking(tmp_path / "bus", vibrating(*levels)):
        assert main(words(tmp_path, "--seconds", "0.5", "--json", "--dbc", f"{tmp_path / 'b.dbc'}")) == 0
        fragment = figures(capsys.readouterr().out)["machine_file"]
        written = new(tmp_path, "--bus=can-dbc", "--dbc=b.dbc", "--rate=600")
        said = capsys.readouterr().out
        (tmp_path / "new.toml").rename(tmp_path / "guess.toml")
        one = only_stream(new(tmp_path, "--bus=can-dbc", "--dbc=b.dbc", "--rate=600", "--consecutive=yes"))
    text, as_told = ((tmp_path / name).read_text("utf-8") for name in ("guess.toml", "new.toml"))
    assert [each["name"] for each in one["layout"]["channels"]] == ["Beschl"]
    assert "assumed" not in as_told.partition("channels = [")[2].partition("\n]")[0]
    for tables in (written, tomllib.loads(fragment)):
        assert [each["name"] for each in only_stream(tables)["layout"]["channels"]] == channels
    assert names_in(written) == names_in(tomllib.loads(fragment))
    is_guess = len(channels) == 1
    lines = [line for line in (text + fragment).splitlines() if line.startswith('  { name = "Beschl')]
    assert ["# assumed" in line for line in lines] == [is_guess] * len(lines)
    how = '# If these are separate sensors: { name = "Beschl_0", signals = ["Beschl_0"] } and so on'
    assert (how in text, how in fragment) == (is_guess, is_guess)
    [assumed] = [line for line in said.splitlines() if line.startswith("Assumed, as nobody has stated it: ")]
    assert ("channels" in assumed) == is_guess
    head = comments(tmp_path / "guess.toml")
    assert ("are read as 3 samples of Beschl: a guess by their names." in head) == is_guess
    assert ("are read as 3 channels, as their levels differ" in head) != is_guess


@pytest.mark.usefixtures("hub")
def test_two_devices_with_one_id_are_seen_by_their_rate(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(questions, "_LISTEN_S", 1.0)
    cycle = 'BA_DEF_ BO_ "GenMsgCycleTime" INT 0 10000;\nBA_ "GenMsgCycleTime" BO_ 700 '
    (tmp_path / "s.dbc").write_text(f"{SEVERITY}{cycle}100;\n")

    def two(bus: UnixBus, number: int) -> None:
        value = 64 if number % 2 else 160
        payload = bytes([(number // 2 + value // 8) % 256]) + value.to_bytes(2, "little", signed=True) + b"\0"
        bus.send(can.Message(arbitration_id=700, is_extended_id=False, data=payload))

    given = ("--bus=can-dbc", "--dbc=s.dbc")
    with talking(tmp_path / "bus", two):
        assert main(words(tmp_path, "--seconds", "1", "--dbc", f"{tmp_path / 's.dbc'}")) == 0
        shown = capsys.readouterr().out
        assert not_written(tmp_path, *given) == 1
        refused = capsys.readouterr()
        new(tmp_path, *given, "--rate=200", "--signals=Severity")
        said = capsys.readouterr().out
    doubt = (
        "times a second, the DBC file states 10 (every 100 ms): most likely two devices send it with one id"
    )
    assert "# Fast comes " in shown
    for text in (
        shown,
        refused.out,
        refused.err,
        said.partition("is written")[2],
        comments(tmp_path / "new.toml"),
    ):
        assert doubt in text
    assert "Remedy: give each device its own id" in refused.err
    assert "state its rate with --rate" in refused.err


@pytest.mark.usefixtures("hub")
def test_a_device_that_counts_its_frames_may_be_set_to_send_more_often(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cycle = 'BA_DEF_ BO_ "GenMsgCycleTime" INT 0 10000;\nBA_ "GenMsgCycleTime" BO_ 700 '
    (tmp_path / "s.dbc").write_text(f"{SEVERITY}{cycle}100;\n")
    with talking(tmp_path / "bus", severity):
        assert main(words(tmp_path, "--seconds", "0.5", "--dbc", f"{tmp_path / 's.dbc'}")) == 0
    assert "times a second, the DBC file states" not in capsys.readouterr().out


@pytest.mark.usefixtures("hub")
def test_frames_that_are_longer_than_the_dbc_file_states_make_no_stream(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(questions, "_LISTEN_S", 0.5)
    (tmp_path / "s.dbc").write_text(SEVERITY.replace("Fast: 4", "Fast: 3"))

    def listen(bus: BusQuestions, answers: Answers) -> Heard:
        return bus.listen(answers, tmp_path, threading.Event(), print)

    given = {"bus": "can-dbc", "interface": "unixbus", "channel": f"{tmp_path / 'bus'}", "dbc": "s.dbc"}
    with talking(tmp_path / "bus", severity):
        assert main(words(tmp_path, "--seconds", "0.5", "--dbc", f"{tmp_path / 's.dbc'}")) == 0
        shown = capsys.readouterr().out
        assert not_written(tmp_path, "--bus=can-dbc", "--dbc=s.dbc") == 1
        refused = capsys.readouterr().err
        answers = conduct(
            tmp_path / "new.toml", Given(given, defaults=False), lambda one: one.default or "", print, listen
        )
    longer = "frames of Fast have more than the 3 bytes of the DBC file, and a stream does not read them"
    assert "[streams." not in shown
    text = " ".join(machine_text(answers, tmp_path / "new.toml").replace("\n#", "").split())
    for said in (shown, refused, text, "".join(answers["notes"])):
        assert longer in said
    assert "Heard: Severity" not in text


@pytest.mark.parametrize(
    ("rate_hz", "why"),
    [(14.0, ""), (15.0, "the device is set to send it more often, or two"), (19.7, "most likely two")],
)
def test_how_likely_two_devices_are_turns_on_how_often_frames_come(
    tmp_path: Path, rate_hz: float, why: str
) -> None:
    cycle = 'BA_DEF_ BO_ "GenMsgCycleTime" INT 0 10000;\nBA_ "GenMsgCycleTime" BO_ 700 '
    (tmp_path / "s.dbc").write_text(f"{SEVERITY}{cycle}100;\n")
    traffic = next(one for one in map(MessageTraffic, messages_of(tmp_path / "s.dbc")) if one.name == "Fast")
    traffic.frames = 100
    doubt = traffic.rate_doubt(rate_hz)
    assert (f"{why} devices send it with one id" in doubt) if why else not doubt
