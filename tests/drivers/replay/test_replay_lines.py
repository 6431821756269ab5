"""Text logs with lines that somebody has damaged: every other frame is played, whatever the bytes are."""

from __future__ import annotations

import tempfile
from pathlib import Path

import can
import pytest
from can.io import TRCReader
from hypothesis import given, settings
from hypothesis import strategies as st
from support.examples import examples

from drivers.frames import DecodedBatch
from drivers.replay.can_log import CanLog
from drivers.replay.lines import TextLog

pytestmark = pytest.mark.property
FRAMES = 40
EPOCH_S = 1_640_995_200.0


def written(ending: str) -> list[bytes]:
    """The lines of a log of frames that carry their number."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"run{ending}"
        with can.Logger(path) as log:
            for k in range(FRAMES):
                log.on_message_received(
                    can.Message(
                        timestamp=EPOCH_S + k / 1000,
                        arbitration_id=0x123,
                        is_extended_id=False,
                        data=[k, 0xA5, 0, 0],
                        channel=0,
                    )
                )
        return path.read_bytes().splitlines(keepends=True)


LOGS = {ending: written(ending) for ending in (".log", ".asc", ".trc")}


def is_frame(line: bytes) -> bool:
    return b"123" in line and b"A5" in line.upper()


@pytest.mark.parametrize("ending", LOGS)
@settings(deadline=None, max_examples=examples(150))
@given(
    damages=st.lists(
        st.tuples(
            st.integers(0, FRAMES - 1),
            st.integers(0, 60),
            st.integers(0, 12),
            st.binary(max_size=12).map(lambda some: some.replace(b"\n", b"").replace(b"\r", b"")),
        ),
        max_size=12,
    )
)
def test_a_damaged_line_costs_no_other_frame(ending: str, damages: list[tuple[int, int, int, bytes]]) -> None:
    lines = LOGS[ending].copy()
    frames = [k for k, line in enumerate(lines) if is_frame(line)]
    assert len(frames) == FRAMES
    for number, at, length, instead in damages:
        line = lines[frames[number]].rstrip()
        lines[frames[number]] = line[:at] + instead + line[at + length :] + b"\n"
    damaged = {number for number, *_ in damages}
    found: list[can.Message] = []

    def keep(messages: list[can.Message], _t_ns: object) -> DecodedBatch:
        found.extend(messages)
        return DecodedBatch()

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"run{ending}"
        path.write_bytes(b"".join(lines))
        log = CanLog(path, keep)
        malformed = 0
        while (piece := log.read(10**18)) is not None:
            malformed += piece.notes.get("frames_malformed", 0)
        log.close()
    played = iter([bytes(message.data) for message in found if message.arbitration_id == 0x123])
    # What is left of a damaged line may be a frame, though another one.
    assert all(bytes([k, 0xA5, 0, 0]) in played for k in range(FRAMES) if k not in damaged)
    assert len(found) + malformed <= FRAMES
    assert bool(log.first_malformed) == bool(malformed)


def test_a_header_that_no_reader_takes_is_the_end_and_not_begun_for_ever(tmp_path: Path) -> None:
    log = tmp_path / "run.trc"
    log.write_text(
        ";$FILEVERSION=x.1\n;$STARTTIME=y\n;---\n 1 0.000 DT 1 0101 Rx - 8 00 00 00 00 00 00 00 00\n"
    )
    played = TextLog(log.open(encoding="utf-8"), TRCReader)
    with pytest.raises(ValueError, match="could not convert string to float"):
        list(played)
    played.close()
