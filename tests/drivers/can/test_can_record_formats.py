"""Frames of any kind come out of a log as they went in, however they were cut into batches and flushes."""

from __future__ import annotations

import tempfile
from pathlib import Path

import can
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.examples import examples

from drivers.can.adapter import batch_of
from drivers.can.batches import ERROR
from drivers.can.record_files import ENDINGS, LogFile, encoder_for
from drivers.frames import DecodedBatch
from drivers.replay.can_log import CanLog

pytestmark = pytest.mark.property
FD_LENGTHS = (*range(9), 12, 16, 20, 24, 32, 48, 64)
ids = st.one_of(
    st.tuples(st.integers(0, 2**11 - 1), st.just(False)), st.tuples(st.integers(0, 2**29 - 1), st.just(True))
)
frames = st.one_of(
    st.builds(
        lambda i, data: can.Message(arbitration_id=i[0], is_extended_id=i[1], data=data),
        ids,
        st.binary(max_size=8),
    ),
    st.builds(
        lambda i, dlc: can.Message(arbitration_id=i[0], is_extended_id=i[1], is_remote_frame=True, dlc=dlc),
        ids,
        st.integers(0, 8),
    ),
    st.builds(
        lambda i, n, fill, brs, esi: can.Message(
            arbitration_id=i[0],
            is_extended_id=i[1],
            is_fd=True,
            data=bytes([fill]) * n,
            bitrate_switch=brs,
            error_state_indicator=esi,
        ),
        ids,
        st.sampled_from(FD_LENGTHS),
        st.integers(0, 255),
        st.booleans(),
        st.booleans(),
    ),
    st.builds(
        lambda i, data: can.Message(
            arbitration_id=i, is_extended_id=False, is_error_frame=True, data=data, dlc=8
        ),
        st.integers(1, 2**29 - 1),
        st.binary(min_size=8, max_size=8),
    ),
)


def what(message: can.Message, log_format: str) -> tuple[object, ...]:
    """What a format keeps of a frame, as python-can reads it."""
    if message.is_error_frame and log_format != "blf":
        return ("error",)
    remote = message.is_remote_frame or (log_format == "asc" and message.is_fd and not message.data)
    return (
        message.arbitration_id,
        message.is_extended_id,
        message.is_error_frame,
        remote,
        message.is_fd,
        message.bitrate_switch,
        message.error_state_indicator,
        bytes(message.data),
        message.dlc,
    )


def read_again(path: Path) -> list[can.Message]:
    """The frames of a log, as the replay driver gets them."""
    found: list[can.Message] = []

    def keep(messages: list[can.Message], _t_ns: object) -> DecodedBatch:
        found.extend(messages)
        return DecodedBatch()

    log = CanLog(path, keep)
    while log.read(10**18) is not None:
        pass
    log.close()
    return found


@pytest.mark.parametrize("log_format", ENDINGS)
@settings(max_examples=examples(60))
@given(
    batches=st.lists(
        st.tuples(st.lists(frames, min_size=1, max_size=12), st.booleans()), min_size=1, max_size=6
    ),
    steps_us=st.lists(st.integers(-100, 10**7), min_size=72, max_size=72),
)
def test_what_goes_in_comes_out(
    log_format: str, batches: list[tuple[list[can.Message], bool]], steps_us: list[int]
) -> None:
    t_us = np.cumsum(steps_us) + 1_790_000_000_000_000
    expected_us = np.maximum.accumulate(t_us)
    sent: list[can.Message] = []
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"run{ENDINGS[log_format]}"
        log = LogFile(path, encoder_for(log_format, "can3"), 0)
        for part, flushed in batches:
            times = t_us[len(sent) : len(sent) + len(part)]
            log.add(batch_of(part, (1000 * times).tolist()).kept())
            sent += part
            if flushed:
                log.flush()
        log.flush()
        assert path.stat().st_size == log.size
        log.close()
        found = read_again(path)
    assert [what(m, log_format) for m in found] == [what(m, log_format) for m in sent]
    times_us = np.array([round(message.timestamp * 1e6) for message in found])
    n = len(sent)
    np.testing.assert_array_equal(np.diff(times_us), np.diff(expected_us[:n]))
    if log_format != "asc":
        np.testing.assert_array_equal(times_us, expected_us[:n])


@pytest.mark.parametrize("log_format", ENDINGS)
def test_frames_may_lie_across_the_containers_of_a_log(log_format: str, tmp_path: Path) -> None:
    """A container of BLF takes 128 KiB; one flush may fill several."""
    n = 5000
    sent = [can.Message(arbitration_id=k % 2000, is_fd=True, data=k.to_bytes(64, "big")) for k in range(n)]
    log = LogFile(tmp_path / f"run{ENDINGS[log_format]}", encoder_for(log_format, "can0"), 0)
    for half in (sent[: n // 2], sent[n // 2 :]):
        log.add(batch_of(half, [1_790_000_000_000_000_000] * len(half)).kept())
        log.flush()
    log.close()
    found = read_again(log.path)
    assert [bytes(message.data) for message in found] == [bytes(message.data) for message in sent]
    assert not (batch_of(found, [0] * n).ids & np.uint32(ERROR)).any()
