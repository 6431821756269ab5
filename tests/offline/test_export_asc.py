"""The begin of an ASC log is what its header says, in UTC, wherever and however it is read."""

from __future__ import annotations

import gzip
import re
import time

import can
import numpy as np
import pytest
from support.orbit_files import RATE_HZ
from support.paths import ROOT

from daqsvc.cli import main
from daqsvc.offline.can_logs import load_can_streams
from daqsvc.settings import load_machine_file
from drivers.can.plugin import frame_layout

pytestmark = pytest.mark.integration
NOT_SAID = "does not state when it began, so the result does not either"
TRIGGERED = "date Wed Nov 25 22:52:36.424 2026\nBegin Triggerblock Mon Nov 23 {} 2026\n"
HEADERS = {
    "trigger": (TRIGGERED.format("14:58:31.125"), "2026-11-23T14:58:31.125"),
    "afternoon": (TRIGGERED.format("02:58:31.125 pm"), "2026-11-23T14:58:31.125"),
    "midnight": (TRIGGERED.format("12:00:00 am"), "2026-11-23T00:00:00.000"),
    "date": ("date Mon Nov 23 14:58:31.125 2026\nBegin Triggerblock\n", "2026-11-23T14:58:31.125"),
    "german": ("date Mon M\u00e4r 23 14:58:31 2026\n", "2026-03-23T14:58:31.000"),
    "none": ("", ""),
    "no date": ("date Mon Nov 33 27:58:31 2026\n", ""),
    "no hour": ("date Mon Nov 23 13:58:31 pm 2026\n", ""),
}


@pytest.fixture
def new_york(monkeypatch):
    """Where somebody reads it."""
    monkeypatch.setenv("TZ", "America/New_York")
    time.tzset()
    yield
    monkeypatch.undo()
    time.tzset()


@pytest.fixture
def machine(tmp_path):
    text = (ROOT / "config" / "machines" / "rotor-synchronous.toml").read_text()
    path = tmp_path / "machine.toml"
    path.write_text(re.sub(r"^rate_hz = 1600.0", f"rate_hz = {RATE_HZ}", text, flags=re.MULTILINE))
    return path


def write_log(path, machine, header):
    """A log whose first frame comes as it begins, with a line in front that is no frame."""
    layout = frame_layout(load_machine_file(machine), "shaft")
    n = layout.samples_per_frame
    with can.Logger(path) as logger:
        for number, payload in enumerate(
            layout.encode(np.arange(100) * n, np.zeros((100, n, 3), np.float32))
        ):
            logger.on_message_received(
                can.Message(
                    timestamp=1e9 + number * n / RATE_HZ,
                    arbitration_id=layout.frame_id,
                    is_extended_id=False,
                    is_fd=True,
                    channel=0,
                    data=payload.tobytes(),
                )
            )
    frames = [line for line in path.read_text().splitlines(keepends=True) if "CANFD" in line]
    head = f"{header}base hex  timestamps absolute\n 0.000000 Start of measurement\n 0.000000 CANFD zz\n"
    path.write_text(head + "".join(frames), encoding="utf-8")


@pytest.mark.usefixtures("new_york")
@pytest.mark.parametrize("header", HEADERS)
@pytest.mark.parametrize("zipped", [False, True])
def test_the_begin_is_that_of_the_header(machine, tmp_path, header, zipped):
    text, begin = HEADERS[header]
    log = tmp_path / "run.asc"
    write_log(log, machine, text)
    if zipped:
        log = tmp_path / "run.asc.gz"
        log.write_bytes(gzip.compress((tmp_path / "run.asc").read_bytes()))
    (stream,), notes = load_can_streams(load_machine_file(machine), str(log))
    # The last sample of a frame is taken when it is sent.
    frame_ns = round(
        (frame_layout(load_machine_file(machine), "shaft").samples_per_frame - 1) / RATE_HZ * 1e9
    )
    said = [note for note in notes if NOT_SAID in note]
    if begin:
        expected_ns = np.datetime64(begin, "ns").astype(np.int64) - frame_ns
        assert stream.start_ns == pytest.approx(expected_ns, abs=2e6)
        assert said == []
    else:
        assert stream.start_ns is None
        assert said == [f"{log} {NOT_SAID}"]


@pytest.mark.usefixtures("new_york")
def test_export_writes_it(machine, tmp_path, capsys):
    write_log(tmp_path / "run.asc", machine, HEADERS["date"][0])
    command = ["export", str(machine), str(tmp_path / "run.asc"), "--to", str(tmp_path / "run.csv")]
    assert main(command) == 0
    assert "# start_time = 2026-11-23T14:58:31.12" in (tmp_path / "run.csv").read_text()
    assert NOT_SAID not in capsys.readouterr().err
