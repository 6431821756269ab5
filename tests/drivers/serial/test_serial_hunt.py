"""The compiled hunt for sync words against the same rules written with Python's own searches."""

from __future__ import annotations

import binascii

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.serial.kernels import MOST_STRAY, SyncSearch, hunt

pytestmark = pytest.mark.property
WORD = b"\xa5\x5a"
LENGTHS = {1: 5, 2: 9}


def by_search(
    buffer: bytes, step: SyncSearch, *, checked: bool
) -> tuple[list[tuple[int, int, bool]], SyncSearch, list[int]]:
    """Bodies as (start, end, intact); where the hunt stands then; garbage, malformed and resyncs."""
    taken, at, fresh, astray, stray = step
    resume, bodies, counts = at, [], [0, 0, 0]
    follows = b"" if checked else WORD
    longest = len(WORD) + max(LENGTHS.values())

    def garbage(length: int) -> None:
        nonlocal astray
        counts[0] += length
        if not fresh:
            counts[1] += not astray
            astray = True

    while (at := buffer.find(WORD, at)) >= 0:
        start = at + len(WORD)
        if start == len(buffer):
            break
        length = LENGTHS.get(buffer[start])
        if length is None:
            at += 1
            continue
        end = start + length
        if end + len(follows) > len(buffer):
            break
        body = buffer[start:end]
        good = buffer.startswith(follows, end) and not (checked and binascii.crc_hqx(body, 0xFFFF))
        if not checked and good:
            stray = 0
        elif not checked:
            count = stray_behind(buffer, end, stray)
            if count is None:
                break
            good, stray = count > 0, count or stray
        if good:
            if at > taken:
                garbage(at - taken)
            counts[2] += astray
            fresh = astray = False
            resume = end
        if good or (at == taken and not fresh and not astray):
            bodies.append((start, end, good))
            taken = end
        at = end if good else at + 1
    if at < 0:
        at = max(resume, len(buffer) - len(WORD) + 1)
    if at - taken > 2 * longest:
        garbage(at - taken)
        taken = at
    return bodies, SyncSearch(taken, at, fresh, astray, stray), counts


def stray_behind(buffer: bytes, end: int, known: int) -> int | None:
    """Bytes behind a frame that the next one has, too, before its sync word; None: not known yet."""
    if end + len(WORD) + MOST_STRAY > len(buffer):
        return None
    if known and buffer.startswith(WORD, end + known):
        return known
    for count in range(1, MOST_STRAY + 1):
        start = end + count + len(WORD)
        if not buffer.startswith(WORD, end + count):
            continue
        if start >= len(buffer):
            return None
        if buffer[start] not in LENGTHS:
            continue
        following = start + LENGTHS[buffer[start]]
        if following + count + len(WORD) > len(buffer):
            return None
        if buffer.startswith(WORD, following + count) and not buffer.startswith(WORD, following):
            return count
    return 0


def compiled(
    buffer: bytes, step: SyncSearch, *, checked: bool
) -> tuple[list[tuple[int, int, bool]], SyncSearch, list[int]]:
    """The same by the kernel."""
    lengths = np.full(256, -1)
    lengths[list(LENGTHS)] = list(LENGTHS.values())
    found = hunt(
        np.frombuffer(buffer, np.uint8).copy(),
        np.frombuffer(WORD, np.uint8).copy(),
        lengths,
        (min(LENGTHS.values()), max(LENGTHS.values())),
        0xFFFF if checked else -1,
        False,
        step,
    )
    bodies = list(zip(found.starts.tolist(), found.ends.tolist(), found.intact.tolist(), strict=True))
    return bodies, found.step, [found.garbage_bytes, found.malformed, found.resyncs]


def framed(key: int, filling: bytes) -> bytes:
    """A sound frame."""
    body = (bytes([key]) + filling * 9)[: LENGTHS[key] - 2]
    return WORD + body + binascii.crc_hqx(body, 0xFFFF).to_bytes(2, "big")


FRAMES = st.builds(
    framed, st.sampled_from([1, 2]), st.sampled_from([b"\x00", b"\xa5\x5a\x01", b"\x5a", b"\x01"])
)
PIECES = st.one_of(
    FRAMES,
    st.tuples(st.lists(FRAMES, max_size=5), st.sampled_from([b"\0", b"\r\n", b"\xa5"])).map(
        lambda t: b"".join(frame + t[1] for frame in t[0])
    ),
    st.tuples(FRAMES, st.integers(0, 12), st.integers(0, 255)).map(
        lambda t: t[0][: t[1]] + bytes([t[2]]) + t[0][t[1] + 1 :]
    ),
    st.tuples(FRAMES, st.integers(0, 12)).map(lambda t: t[0][: t[1]]),
    st.sampled_from([WORD, b"\xa5", WORD + b"\x01", WORD + b"\x02", b"\x00" * 20]),
    st.binary(max_size=30),
)


@pytest.mark.parametrize("checked", [True, False])
@given(chunks=st.lists(st.lists(PIECES, max_size=6).map(b"".join), max_size=6))
def test_whatever_comes_however_it_is_cut_both_find_the_same(checked, chunks) -> None:
    rest, step = b"", SyncSearch()
    for chunk in chunks:
        buffer = rest + chunk
        found = compiled(buffer, step, checked=checked)
        assert found == by_search(buffer, step, checked=checked)
        taken, tried, *state = found[1]
        start = min(taken, tried)
        rest, step = buffer[start:], SyncSearch(taken - start, tried - start, *state)
