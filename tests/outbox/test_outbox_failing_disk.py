"""A file system that fails in the middle of a commit: what is called stored is on it afterwards, and the rest
is told apart.
"""

from __future__ import annotations

import asyncio
import random

import pytest
from support.small_disks import failing

from daqsvc.acquisition.clock import SystemClock
from daqsvc.outbox import writer
from daqsvc.outbox.limits import OutboxLimits
from daqsvc.outbox.messages import OutboxError
from daqsvc.outbox.store import Outbox

pytestmark = pytest.mark.integration
LIMITS = OutboxLimits(reserve_bytes=0, ballast_bytes=0)


def text(number):
    return (b"number %d " % number) * 20


async def life(directory, rng, fail, known, told):
    """Commit and publish until the disk fails, and a while longer; then stop as for SIGTERM.

    Args:
        directory: of the store.
        rng: says when the disk fails.
        fail: has it fail.
        known: payloads by number, of all that was ever published as stored or said to be on disk.
        told: payloads by number, of all that was published from memory.
    """
    outbox = Outbox(directory / "store" / "outbox.sqlite", SystemClock(), LIMITS)
    await outbox.open()
    under_way = set()
    numbers = set()

    def committed(done):
        under_way.discard(done)
        if not done.cancelled() and done.exception() is None:
            assert done.result() not in numbers
            numbers.add(done.result())

    async def publish():
        read_to = 0
        while True:
            for message in await outbox.next_pending(read_to, 50):
                kept = known if message.stored else told
                assert kept.setdefault(message.sequence, message.payload) == message.payload
                assert told.get(message.sequence, message.payload) == message.payload
                read_to = message.sequence
                outbox.mark_sent(message.sequence)

    publishing = asyncio.create_task(publish())
    left = rng.randrange(5, 60)
    while outbox.counters.write_errors < 2:
        for _ in range(rng.randrange(1, 8)):
            salt = b"%016x " % rng.getrandbits(64)
            done = outbox.submit("t", lambda number, salt=salt: salt + text(number), retain=False)
            under_way.add(done)
            done.add_done_callback(committed)
        await asyncio.sleep(rng.choice([0.0, 0.0, 0.001, 0.004]))
        left -= 1
        if not left:
            fail()
    publishing.cancel()
    await asyncio.gather(publishing, return_exceptions=True)
    await outbox.close(5.0)
    await asyncio.gather(*under_way, return_exceptions=True)
    for number in numbers:
        known.setdefault(number, None)


async def rounds(tmp_path, seeds, caplog):
    from_memory = 0
    for seed in seeds:
        rng = random.Random(seed)
        here = tmp_path / f"{seed}"
        here.mkdir()
        known, told = {}, {}
        with failing(here) as disk:
            for _ in range(3):
                how = rng.choice([0, 1, 2])
                await life(disk.directory, rng, lambda how=how: disk.fail(how), known, told)
                # A restart while the disk still fails reads back what the system holds in memory only.
                outbox = Outbox(disk.directory / "store" / "outbox.sqlite", SystemClock(), LIMITS)
                await outbox.open()
                assert outbox.counters.shut == 1
                reading = asyncio.create_task(outbox.following(0, 10**6))
                await asyncio.wait({reading}, timeout=0.1)
                was_read = reading.done()
                if was_read:
                    known.update({m.sequence: m.payload for m in reading.result() if m.sequence not in known})
                await outbox.close()
                if not was_read:
                    with pytest.raises(OutboxError, match="was closed"):
                        await reading
                await asyncio.to_thread(disk.unmount)
                await asyncio.to_thread(disk.mount)
                outbox = Outbox(disk.directory / "store" / "outbox.sqlite", SystemClock(), LIMITS)
                await outbox.open()
                there = {m.sequence: m.payload for m in await outbox.following(0, 10**6)}
                missing = sorted(set(known) - set(there))
                assert not missing, f"seed {seed}, {how}: published or promised, not on the disk; {was_read=}"
                assert all(payload in {None, there[number]} for number, payload in known.items()), (
                    f"seed {seed}"
                )
                assert all(there.get(number, payload) == payload for number, payload in told.items()), (
                    f"seed {seed}: what was told from memory is another event on the disk"
                )
                known.update(there)
                after = await outbox.append("t", text, retain=False)
                assert after > max([*known, *told]), f"seed {seed}: a number is used twice"
                known[after] = text(after)
                assert outbox.counters.quarantined == outbox.counters.vanished == 0
                await outbox.close()
        from_memory += len(told)
    assert from_memory > 0, "enough of it was told from memory"
    assert "Traceback" not in caplog.text


@pytest.fixture(autouse=True)
def _quick(monkeypatch):
    monkeypatch.setattr(writer, "RETRY_MOST_S", 0.05)


@pytest.mark.long
async def test_what_is_published_is_on_the_disk_whenever_that_fails(tmp_path, caplog):
    await rounds(tmp_path, range(3), caplog)


@pytest.mark.long
@pytest.mark.marathon
@pytest.mark.timeout(900)
async def test_what_is_published_is_on_the_disk_whenever_that_fails_in_many_rounds(tmp_path, caplog):
    await rounds(tmp_path, range(100, 130), caplog)
