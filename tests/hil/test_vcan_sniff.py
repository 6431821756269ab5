"""``daqsvc sniff can`` on a CAN interface of the kernel, with can-utils as the talkers."""

from __future__ import annotations

import contextlib
import json
import subprocess
import sys
import threading
from typing import TYPE_CHECKING, Any

from support.paths import ROOT
from support.waiting import PATIENCE_S

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from support.vcan_links import VcanLink

DBC = ROOT / "config" / "devices" / "triaxial-accelerometer.dbc"


@contextlib.contextmanager
def sniffing(*arguments: str) -> Iterator[subprocess.Popen[str]]:
    command = [sys.executable, "-m", "daqsvc", "sniff", "can", *arguments]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    try:
        yield process
    finally:
        process.kill()
        process.communicate()


def begun(process: subprocess.Popen[str]) -> None:
    """Wait until it listens."""
    assert process.stderr is not None
    line = process.stderr.readline()
    assert line.startswith("listening to "), line


def ended(process: subprocess.Popen[str]) -> tuple[dict[str, Any], str]:
    process.send_signal(2)
    output, said = process.communicate(timeout=PATIENCE_S)
    found: dict[str, Any] = json.loads(output)
    return found, said


def test_vcan_frames_of_cangen_are_counted_to_the_last(vcan: VcanLink) -> None:
    with sniffing(vcan.name, "--seconds", "600", "--json") as process:
        begun(process)
        for more in (
            ("-I", "123", "-L", "8", "-D", "i", "-g", "2", "-n", "300"),
            ("-e", "-I", "18FF0102", "-L", "3", "-D", "010203", "-g", "1", "-n", "50"),
            ("-f", "-b", "-I", "200", "-L", "24", "-D", "r", "-g", "1", "-n", "40"),
            ("-R", "-I", "300", "-L", "0", "-g", "1", "-n", "5"),
        ):
            subprocess.run(["cangen", vcan.name, *more], check=True)
        threading.Event().wait(0.3)
        found, said = ended(process)
    assert (process.returncode, said, found["frames_dropped"]) == (0, "", 0)
    ids = {(one["id"], one["extended"], one["remote"]): one for one in found["ids"]}
    assert {key: one["frames"] for key, one in ids.items()} == {
        (0x123, False, False): 300,
        (0x18FF0102, True, False): 50,
        (0x200, False, False): 40,
        (0x300, False, True): 5,
    }
    counting, fd = ids[0x123, False, False], ids[0x200, False, False]
    same = ids[0x18FF0102, True, False]
    assert counting["counter"] == {"byte": 0, "bits": 16, "order": "little", "step": 1}
    assert counting["changed_bytes"] == [0, 1]
    assert (same["changed_bytes"], same["last"], same["lengths"]) == ([], "010203", [3])
    assert (fd["fd"], fd["bit_rate_switch"], fd["lengths"]) == (True, True, [24])
    assert "fd = true" in found["machine_file"]


def test_vcan_a_log_that_canplayer_plays_is_decoded_by_its_dbc_file(vcan: VcanLink, tmp_path: Path) -> None:
    log = tmp_path / "run.log"
    # 1 kHz: AccelX from -50 to 49 counts of 0.0005 g.
    log.write_text(
        "".join(
            f"({k / 1000:.6f}) {vcan.name} 201#{k:02X}"
            f"{(k - 50).to_bytes(2, 'little', signed=True).hex()}0000000000\n"
            for k in range(100)
        )
    )
    with sniffing(vcan.name, "--seconds", "600", "--json", "--dbc", str(DBC)) as process:
        begun(process)
        subprocess.run(["canplayer", "-I", str(log), f"{vcan.name}={vcan.name}"], check=True)
        threading.Event().wait(0.3)
        found, _ = ended(process)
    [message] = found["dbc"]["messages"]
    signals = {one["signal"]: one for one in message["signals"]}
    assert message["frames"] == 100
    assert (signals["AccelX"]["min"], signals["AccelX"]["max"]) == (-0.025, 0.0245)
    assert signals["AccelX"]["unit"] == "g"
    assert signals["Sequence"]["counts_frames"] is True
    machine = tmp_path / "machine.toml"
    machine.write_text(
        'schema_version = 1\nsite = "lab"\nbox = "edge-1"\n[machine]\nname = "fan"\nspeed_rpm = 1480.0\n'
        + found["machine_file"]
    )
    done = subprocess.run(
        [sys.executable, "-m", "daqsvc", "check", str(machine)], capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stderr) == (0, "")


def test_vcan_missing_and_down_are_told_apart(vcan: VcanLink) -> None:
    def said() -> tuple[int, str]:
        with sniffing(vcan.name, "--seconds", "0.2") as process:
            _, words = process.communicate(timeout=PATIENCE_S)
            return process.returncode, words

    code, words = said()
    assert code == 1
    assert "no frame in 0.2 s. Remedy: " in words
    vcan.down()
    assert said() == (1, f"daqsvc: {vcan.name} is down. Remedy: ip link set {vcan.name} up [C21]\n")
    vcan.remove()
    code, words = said()
    assert code == 1
    assert words.startswith(f"daqsvc: there is no CAN interface {vcan.name} (")
    assert f"ip link add dev {vcan.name} type vcan" in words


def test_vcan_an_interface_that_goes_down_ends_it_with_what_was_heard(vcan: VcanLink) -> None:
    with sniffing(vcan.name, "--seconds", "600") as process:
        begun(process)
        subprocess.run(["cangen", vcan.name, "-I", "123", "-L", "2", "-g", "1", "-n", "20"], check=True)
        threading.Event().wait(0.3)
        vcan.down()
        output, words = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 1
    assert "20 frames in " in output
    assert f"{vcan.name} was lost after " in words
    assert "Network is down" in words
