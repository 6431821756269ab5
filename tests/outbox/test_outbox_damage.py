"""A journal damaged at random: the service starts, tells no lie, and uses no number twice."""

from __future__ import annotations

import asyncio
import contextlib
import random
import shutil
import tempfile
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from support.examples import examples

from daqsvc.acquisition.clock import SystemClock
from daqsvc.notice import NOTICE
from daqsvc.outbox.messages import OutboxError
from daqsvc.outbox.reading import JOURNAL_NAME, read_journal
from daqsvc.outbox.salvage import readable
from daqsvc.outbox.store import Outbox

pytestmark = pytest.mark.property
TOPICS = ["daqsvc/lab/edge-1/rig/alarms/a", "daqsvc/lab/edge-1/rig/alarms/b"]
COUNT = 120

MEMORY = "/dev/shm" if Path("/dev/shm").is_dir() else None  # noqa: S108


def payload(sequence):
    return (b"number %d " % sequence) * (1 + sequence % 40)


async def fill(path):
    outbox = Outbox(path, SystemClock())
    await outbox.open()
    numbers = [await outbox.append(TOPICS[n % 2], payload, retain=True) for n in range(COUNT)]
    for number in numbers[: COUNT // 2]:
        outbox.mark_sent(number)
    await outbox.pending_telemetry(0, 1)
    return outbox, numbers


@pytest.fixture(scope="module")
def stores(tmp_path_factory):
    """The same journal properly closed and as kill -9 leaves it; and the numbers used."""
    directory = tmp_path_factory.mktemp("stores")

    async def made():
        outbox, numbers = await fill(directory / "closed" / JOURNAL_NAME)
        await outbox.pending(0, 1)
        shutil.copytree(directory / "closed", directory / "killed")
        await outbox.close()
        return numbers

    numbers = asyncio.run(made())
    return {"closed": directory / "closed", "killed": directory / "killed"}, numbers


async def restarted(store, numbers):
    """Open the damaged store and look at all of it; then go on."""
    outbox = Outbox(store / JOURNAL_NAME, SystemClock())
    await outbox.open()
    try:
        async with asyncio.timeout(20):
            for _ in range(2):
                for message in [
                    *await outbox.pending(0, 10**6),
                    *await outbox.latest(),
                    *await outbox.retained(),
                ]:
                    assert message.sequence in numbers
                    assert message.topic == TOPICS[numbers.index(message.sequence) % 2]
                    assert message.payload == payload(message.sequence)
            after = await outbox.append(TOPICS[0], payload, retain=True)
            pending = await outbox.pending(0, 10**6)
        assert after > max(numbers)
        assert pending[-1].sequence == after
        assert outbox.counters.depth == len(pending)
        return pending, outbox.counters
    finally:
        await outbox.close()


@settings(max_examples=examples(40), suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_flipped_bytes(stores, data):
    kept, numbers = stores
    with tempfile.TemporaryDirectory(dir=MEMORY) as scratch:
        store = Path(scratch) / "store"
        state = data.draw(st.sampled_from(sorted(kept)))
        shutil.copytree(kept[state], store)
        (store / f"{JOURNAL_NAME}-shm").unlink(missing_ok=True)  # the index is memory, not disk
        part = data.draw(
            st.sampled_from([p for p in ("", "-wal") if (store / f"{JOURNAL_NAME}{p}").exists()])
        )
        damaged = store / f"{JOURNAL_NAME}{part}"
        content = bytearray(damaged.read_bytes())
        for _ in range(data.draw(st.sampled_from([1, 1, 3, 100]))):
            # Half of the hits go where it hurts: the headers of the file and of its pages.
            page = data.draw(st.integers(0, max(len(content) // 4096 - 1, 0)))
            at = data.draw(
                st.one_of(
                    st.integers(0, len(content) - 1), st.integers(0, 120).map(lambda n, p=page: p * 4096 + n)
                )
            )
            content[at % len(content)] ^= data.draw(st.integers(1, 255))
        damaged.write_bytes(content)
        with contextlib.suppress(OutboxError):
            view = read_journal(store)
            assert all(entry.payload == payload(entry.sequence) for entry in view.history)
        asyncio.run(restarted(store, numbers))


@settings(max_examples=examples(15), suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_torn_files(stores, data):
    kept, numbers = stores
    with tempfile.TemporaryDirectory(dir=MEMORY) as scratch:
        store = Path(scratch) / "store"
        shutil.copytree(kept["closed"], store)
        whole = (store / JOURNAL_NAME).read_bytes()
        begin = data.draw(st.integers(0, len(whole)))
        end = data.draw(st.integers(begin, len(whole)))
        torn = data.draw(st.sampled_from([whole[:begin], whole[:begin] + bytes(end - begin) + whole[end:]]))
        (store / JOURNAL_NAME).write_bytes(torn)
        asyncio.run(restarted(store, numbers))


def test_one_bad_page_costs_the_messages_on_it_and_no_others(stores, tmp_path):
    kept, numbers = stores
    store = tmp_path / "store"
    shutil.copytree(kept["closed"], store)
    path = store / JOURNAL_NAME
    content = bytearray(path.read_bytes())
    # A number in the middle of what is not sent yet.
    hit = numbers[len(numbers) * 3 // 4]
    page = content.index(payload(hit)) // 4096
    lost = {n for n in numbers if payload(n) in content[page * 4096 : (page + 1) * 4096]}
    content[page * 4096 : (page + 1) * 4096] = b"\xff" * 4096
    path.write_bytes(content)
    pending, counters = asyncio.run(restarted(store, numbers))
    assert hit in lost
    assert counters.quarantined == 1
    saved = {message.sequence for message in pending[:-1]}
    assert saved >= set(numbers[COUNT // 2 :]) - {n for n in numbers if min(lost) - 3 <= n <= max(lost) + 3}
    assert len(saved) > COUNT // 3


@pytest.mark.parametrize("lost", [slice(0, 100), slice(0, 4096), slice(0, 3 * 4096)], ids=str)
def test_a_first_page_that_is_lost_costs_no_message(stores, tmp_path, lost):
    """It has the file's header and the tables' definitions: SQLite finds nothing without."""
    kept, numbers = stores
    store = tmp_path / "store"
    shutil.copytree(kept["closed"], store)
    path = store / JOURNAL_NAME
    content = bytearray(path.read_bytes())
    content[lost] = bytes(lost.stop)
    path.write_bytes(content)
    pending, counters = asyncio.run(restarted(store, numbers))
    assert counters.quarantined == 1
    assert [m.sequence for m in pending[:-1]] == numbers[COUNT // 2 :], "and none that was sent comes again"


def test_a_flipped_bit_in_a_payload_costs_that_message_only(stores, tmp_path):
    """SQLite's own check sees nothing of it."""
    kept, numbers = stores
    store = tmp_path / "store"
    shutil.copytree(kept["closed"], store)
    path = store / JOURNAL_NAME
    hit = numbers[-5]
    path.write_bytes(path.read_bytes().replace(b"number %d " % hit, b"nomber %d " % hit))
    pending, counters = asyncio.run(restarted(store, numbers))
    assert counters.quarantined == 1
    assert [m.sequence for m in pending[:-1]] == [n for n in numbers[COUNT // 2 :] if n != hit]


def spoil(path, rng):
    """Do to a file what disks, file systems and people do."""
    content = bytearray(path.read_bytes())
    match rng.choice(["flip", "flip", "flip", "cut", "zero", "noise", "grow", "delete"]):
        case "flip" if content:
            for _ in range(rng.choice([1, 1, 2, 8, 64])):
                page = rng.randrange(len(content) // 4096 + 1) * 4096
                at = page + rng.randrange(200) if rng.random() < 0.5 else rng.randrange(len(content))
                content[at % len(content)] ^= 1 << rng.randrange(8)
        case "cut":
            del content[rng.randrange(len(content) + 1) :]
        case "zero":
            begin = rng.randrange(len(content) // 4096 + 1) * 4096
            content[begin : begin + 4096] = bytes(len(content[begin : begin + 4096]))
        case "noise":
            content[:] = rng.randbytes(rng.randrange(5000))
        case "grow":
            content += rng.randbytes(rng.randrange(1, 5000))
        case "delete":
            path.unlink()
            return
    path.write_bytes(content)


async def spoilt(stores, seed, caplog):
    kept, numbers = stores
    unsent = set(numbers[COUNT // 2 :])
    rng = random.Random(seed)
    with tempfile.TemporaryDirectory(dir=MEMORY) as scratch:
        store = Path(scratch) / "store"
        shutil.copytree(kept[rng.choice(sorted(kept))], store)
        (store / f"{JOURNAL_NAME}-shm").unlink(missing_ok=True)
        files = sorted(path for path in store.iterdir() if path.name != f"{JOURNAL_NAME}.lock")
        hit = set(rng.sample(files, rng.choice([1, 1, 1, 2, 3])))
        hit |= {store / JOURNAL_NAME} if rng.random() < 0.5 else set()
        for path in sorted(hit):
            spoil(path, rng)
        whole = not {JOURNAL_NAME, f"{JOURNAL_NAME}-wal"} & {path.name for path in hit}
        shutil.copytree(store, Path(scratch) / "read")
        damaged = Path(scratch) / "read" / JOURNAL_NAME
        readable_rows = list(readable(damaged)) if damaged.exists() else []
        caplog.clear()
        before = len(caplog.records)
        pending, counters = await restarted(store, numbers)
        found = {message.sequence for message in pending[:-1]}
        wanted = unsent if whole else {row[0] for row in readable_rows if not row[4] and row[0] in unsent}
        assert wanted <= found, f"seed {seed}: {[path.name for path in hit]}"
        told = [r.getMessage() for r in caplog.records[before:] if r.levelno >= NOTICE]
        if not unsent <= found:
            # With both marks and the log gone, nothing knows that there was more; the marks are told of.
            marks = {f"{JOURNAL_NAME}.sequence", f"{JOURNAL_NAME}.sequence.twin"} <= {p.name for p in hit}
            assert counters.quarantined + counters.vanished > 0 or marks, f"seed {seed}: lost in silence"
            assert any(str(store / JOURNAL_NAME) in sentence for sentence in told)
        assert not [sentence for sentence in told if "Traceback" in sentence]
        return counters.quarantined


@pytest.mark.parametrize(
    "seeds",
    [
        range(40),
        pytest.param(
            range(1000, 2500), marks=[pytest.mark.long, pytest.mark.marathon, pytest.mark.timeout(900)]
        ),
    ],
    ids=str,
)
def test_whatever_is_spoilt_a_start_tells_the_truth_and_repeats_no_number(stores, seeds, caplog):
    quarantined = [asyncio.run(spoilt(stores, seed, caplog)) for seed in seeds]
    assert sum(map(bool, quarantined)) > len(seeds) // 8, "enough of it was damage"
