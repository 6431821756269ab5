"""Whatever a machine or DBC file holds, `check` says it in sentences, and what it lets pass can be run."""

from __future__ import annotations

import os
import random
import re
import resource
import subprocess
import sys
import threading

import pytest
from support.live_service import watch_of
from support.machine_files import LAVAL, MACHINES, TRIAXIAL
from support.machine_mutations import mutated

from daqsvc.box import Box
from daqsvc.cli import main
from daqsvc.detectors.make import check_files
from daqsvc.service import Service
from daqsvc.settings import MachineFileError, describe, load_machine_file, parse_machine_file
from daqsvc.settings.problems import AssemblyError
from drivers.can.plugin import frame_layout

pytestmark = pytest.mark.integration
FAILED = " has failed: "
"""What is said of a plugin that raises (`daqsvc.settings.problems.raised`)."""
RING_BYTES = 200_000_000
DEVICE = MACHINES.parent / "devices" / "triaxial-accelerometer.dbc"
_TOKEN = re.compile(r'"[^"]*"|[A-Za-z_]+|[0-9.]+|[|@()\[\],:;+-]')
_JUNK = [
    *("0", "1", "-1", "9", "64", "65", "0.0", "1e400", "1e-400", "nan", "inf", "999999999999", "2147484161"),
    *("m0", "M", "m0M", '"x"', '""', "|", "@", "@0-", "(0,0)", "(1,1e308)", "[0|0]", "é", "BO_", "SG_"),
    *(
        "SIG_VALTYPE_ 513 AccelX : 1;",
        "SG_MUL_VAL_ 513 AccelX Status 0-1;",
        "SG_MUL_VAL_ 513 AccelX Status 0-9999999;",
    ),
]


def checked(folder, name, data):
    """As `daqsvc check` and, before it opens anything, `daqsvc run` do; whether the file can be used."""
    path = folder / name
    path.write_bytes(data)
    try:
        machine = load_machine_file(path)
        assert FAILED not in describe(machine)
        check_files(machine)
    except MachineFileError as error:
        for problem in error.problems:
            assert problem.message
            assert FAILED not in problem.message
            assert problem.remedy
            assert "\n" not in str(problem)
        return False
    except AssemblyError as error:
        if FAILED in str(error):
            raise
        return False
    service = Service(Box.single(machine), folder / "store")
    taken = sum(ring._data.nbytes for ring in watch_of(service).rings.values())
    assert taken <= RING_BYTES
    return True


def fuzzed(folder, monkeypatch, seeds):
    monkeypatch.setattr("daqsvc.settings.checks.memory_bytes", lambda: 2 * RING_BYTES)
    (folder / "devices").mkdir()
    (folder / "devices" / DEVICE.name).write_bytes(DEVICE.read_bytes())
    (folder / "machines").mkdir()
    usable = 0
    for seed in seeds:
        path, data = mutated(seed)
        try:
            usable += checked(folder / "machines", path.name, data)
        except Exception as error:
            error.add_note(f"of machine_mutations.mutated({seed})")
            raise
    return usable


def test_spoilt_machine_files(tmp_path, monkeypatch):
    usable = fuzzed(tmp_path, monkeypatch, [*range(280), 923, 6705, 9197])
    assert 20 < usable < 200


@pytest.mark.long
@pytest.mark.marathon
@pytest.mark.timeout(3600)
def test_ten_thousand_spoilt_machine_files(tmp_path, monkeypatch):
    assert fuzzed(tmp_path, monkeypatch, range(280, 10_280)) > 1000


def spoilt_dbc(seed):
    rng = random.Random(seed)
    text = DEVICE.read_text(encoding="utf-8")
    if rng.random() < 0.3:
        data = bytearray(text.encode())
        for _ in range(rng.randint(1, 4)):
            data[rng.randrange(len(data))] = rng.randrange(256)
        return bytes(data)
    for _ in range(rng.randint(1, 3)):
        places = list(_TOKEN.finditer(text))
        place = rng.choice(places)
        text = text[: place.start()] + rng.choice([*_JUNK, rng.choice(places)[0]]) + text[place.end() :]
    if rng.random() < 0.2:
        text += f"\n{rng.choice(_JUNK[-3:])}\n"
    return text.encode()


def dbc_fuzzed(folder, seeds):
    text = TRIAXIAL.read_text(encoding="utf-8").replace("../devices/triaxial-accelerometer.dbc", "a.dbc")
    usable = 0
    for seed in seeds:
        (folder / "a.dbc").write_bytes(spoilt_dbc(seed))
        try:
            machine = parse_machine_file(text, folder / "m.toml")
            describe(machine)
            frame_layout(machine, "housing")
        except MachineFileError:
            continue
        except Exception as error:
            error.add_note(f"of spoilt_dbc({seed})")
            raise
        usable += 1
    return usable


def test_spoilt_dbc_files(tmp_path):
    assert 5 < dbc_fuzzed(tmp_path, [*range(200), 2100, 3119]) < 100


@pytest.mark.long
@pytest.mark.marathon
@pytest.mark.timeout(1800)
def test_ten_thousand_spoilt_dbc_files(tmp_path):
    assert dbc_fuzzed(tmp_path, range(200, 10_200)) > 200


# What would take a naive reader minutes or gigabytes.
HUGE = {
    "headers": lambda: "".join(f"[{'a.' * 899}a{i}]\n" for i in range(500)),
    "one key": lambda: f"a{'.a' * 499_000} = 1\n",
    "blanks": lambda: " \n" * 500_000,
    "brackets": lambda: "a = " + "[" * 1_000_000,
    "inline tables": lambda: "a = " + "{a=" * 900 + "1" + "}" * 900,
    "arrays": lambda: "\n".join(f"a{i} = {'[' * 200}{']' * 200}" for i in range(2_000)),
    "elements": lambda: f"a = [{'1,' * 499_000}]",
    "sensors": lambda: "[[sensors]]\n" * 80_000,
    "buses": lambda: "".join(f"[buses.b{i}]\n" for i in range(60_000)),
    "unknown keys": lambda: "".join(f"k{i:x}=1\n" for i in range(90_000)),
    "digits": lambda: "a = " + "9" * 1_000_000,
    "hexadecimal": lambda: "a = 0x" + "f" * 1_000_000,
    "text": lambda: 'a = "' + "\\n" * 499_000 + '"',
    "one word": lambda: "a" * 1_000_000,
    "bad sensors": lambda: (
        LAVAL.read_text() + "".join(f'[[alarms]]\nname="a{i}"\nsensor="s{i}"\n' for i in range(4_000))
    ),
}
_CHILD = """
import resource, sys
from pathlib import Path
from daqsvc.settings import MachineFileError, load_machine_file
folder = Path(sys.argv[1])
try:
    load_machine_file(folder / "sound")
except MachineFileError:
    pass
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
for path in sorted(folder.glob("huge*")):
    try:
        load_machine_file(path)
    except MachineFileError as error:
        assert len(error.problems) < 500
    else:
        sys.exit(f"{path} passes")
    after = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    if after - before > 150_000:
        sys.exit(f"{path} takes {(after - before) / 1e3:.0f} MB")
"""


@pytest.mark.long
def test_huge_files_take_little_memory_and_time(tmp_path):
    (tmp_path / "sound").write_bytes(LAVAL.read_bytes())
    for number, make in enumerate(HUGE.values()):
        (tmp_path / f"huge{number:02}").write_text(make(), encoding="utf-8")
    (tmp_path / "huge-blanks").write_bytes(b" " * 10_000_000)
    done = subprocess.run(
        [sys.executable, "-c", _CHILD, tmp_path],
        check=False,
        capture_output=True,
        text=True,
        # Of processor time, bounded whatever the machine: some of these took minutes.
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_CPU, (90, 90)),
    )
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


def told(path, capsys):
    assert main(["check", str(path)]) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.startswith(f"{path}")
    assert captured.err.count("\n") == 1
    return captured.err


def test_files_that_are_none(tmp_path, capsys):
    pipe = tmp_path / "pipe.toml"
    os.mkfifo(pipe)
    assert "no ordinary file" in told(pipe, capsys)
    assert "no ordinary file" in told("/dev/zero", capsys)
    (tmp_path / "round").symlink_to(tmp_path / "round")
    assert "cannot be read: Too many levels" in told(tmp_path / "round", capsys)
    assert "no such file" in told(tmp_path / "absent.toml", capsys)
    (tmp_path / "large.toml").write_bytes(b" " * 10_000_000)
    assert "larger than 1.05 MB" in told(tmp_path / "large.toml", capsys)
    for name, data, words in [
        ("null", b"a = 1\n\x00\n", "not valid TOML"),
        ("utf-16", LAVAL.read_text().encode("utf-16"), "UTF-16"),
        ("latin", b'# fine\nsite = "K\xf6ln"\n', "byte 0xf6 at column 10"),
        ("long", b"a = " + b"9" * 5000, "hundreds of digits"),
    ]:
        (tmp_path / name).write_bytes(data)
        assert words in told(tmp_path / name, capsys)
    assert threading.active_count() == 1


def test_a_link_to_a_machine_file_and_a_byte_order_mark_are_no_mistake(tmp_path):
    (tmp_path / "m.toml").write_bytes(b"\xef\xbb\xbf" + LAVAL.read_bytes())
    (tmp_path / "link.toml").symlink_to(tmp_path / "m.toml")
    assert load_machine_file(tmp_path / "link.toml").machine.name == "laval-rig"


@pytest.mark.parametrize("kind", ["pipe", "device", "large", "directory"])
def test_dbc_files_that_are_none(tmp_path, kind):
    file = tmp_path / "a.dbc"
    if kind == "pipe":
        os.mkfifo(file)
    elif kind == "device":
        file.symlink_to("/dev/zero")
    elif kind == "large":
        file.write_bytes(DEVICE.read_bytes() + b" " * 5_000_000)
    else:
        file.mkdir()
    text = TRIAXIAL.read_text(encoding="utf-8").replace("../devices/triaxial-accelerometer.dbc", "a.dbc")
    with pytest.raises(MachineFileError) as caught:
        parse_machine_file(text, tmp_path / "m.toml")
    (problem,) = caught.value.problems
    assert problem.key == "streams.housing.layout.dbc"
    assert str(file) in problem.message
