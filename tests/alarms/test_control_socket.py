"""The control socket: what it takes, what it refuses, and that no client can hurt the service."""

from __future__ import annotations

import asyncio
import contextlib
import errno
import json
import os
import socket
import stat
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from support.formats import fits
from support.given_codes import had
from support.small_disks import mounted
from support.waiting import eventually

from daqsvc import control
from daqsvc.acquisition.clock import SystemClock
from daqsvc.alarms.commands import AlarmCommand, CommandOutcome, Verb
from daqsvc.cli import main
from daqsvc.control import (
    AbsentError,
    ControlError,
    ControlRequest,
    ControlServer,
    UnreachableError,
    ask,
    ask_snapshot,
    ask_status,
    events_waiting,
    request_of,
)
from daqsvc.outbox.files import is_possessed, take_possession
from daqsvc.outbox.limits import OutboxLimits
from daqsvc.outbox.store import Outbox

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

pytestmark = pytest.mark.integration
MACHINE = "laval-rig"
NOBODY = 65_534
RESET = ControlRequest(schema="daqsvc.control/1", verb=Verb.RESET, alarm="a", by="b")


class Desk:
    """Remembers what it was told, and obeys when it is let."""

    def __init__(self) -> None:
        self.told: list[tuple[AlarmCommand, str]] = []
        self.may_answer = asyncio.Event()
        self.may_answer.set()

    async def __call__(self, command: AlarmCommand, source: str) -> CommandOutcome:
        self.told.append((command, source))
        await self.may_answer.wait()
        if command.alarm == "nothing":
            return CommandOutcome(accepted=False, reason="no alarm is named 'nothing'", code="C05")
        return CommandOutcome(accepted=True, events=("edge-1-17",))


@contextlib.asynccontextmanager
async def serving(store: Path, desk: Desk | None = None) -> AsyncIterator[ControlServer]:
    server = ControlServer(store, (MACHINE,), desk or Desk())
    await server.open()
    try:
        yield server
    finally:
        await server.close()


def wish(**keys: Any) -> dict[str, Any]:
    return {
        "schema": "daqsvc.control/1",
        "verb": "acknowledge",
        "alarm": "rotor-fault",
        "by": "ann",
    } | keys


async def say(server: ControlServer, line: bytes) -> dict[str, Any]:
    reader, writer = await asyncio.open_unix_connection(server.path)
    try:
        writer.write(line)
        async with asyncio.timeout(10):
            answer: dict[str, Any] = json.loads(await reader.readline())
        return fits("daqsvc.control-answer/1", answer)
    finally:
        writer.close()


async def test_a_request_becomes_a_command_with_the_kernels_word_for_who_asks(tmp_path: Path) -> None:
    desk = Desk()
    asked = wish(verb="shelve", duration_s=1800, reason="spare part on order", machine=MACHINE)
    async with serving(tmp_path, desk) as server:
        answer = await say(server, json.dumps(asked).encode() + b"\n")
    assert answer == {
        "schema": "daqsvc.control-answer/1",
        "accepted": True,
        "reason": "",
        "code": None,
        "events": ["edge-1-17"],
        "waiting": 0,
    }
    (told,) = desk.told
    command = AlarmCommand(
        verb=Verb.SHELVE,
        alarm="rotor-fault",
        by="ann",
        duration_s=1800.0,
        reason="spare part on order",
        machine=MACHINE,
    )
    assert told == (command, f"local uid {os.getuid()} pid {os.getpid()}")


async def test_the_client_and_the_server_understand_each_other(tmp_path: Path) -> None:
    desk = Desk()
    request = ControlRequest(
        schema="daqsvc.control/1", verb=Verb.RESET, alarm="nothing", by="ann", occurrence="0d8c"
    )
    async with serving(tmp_path, desk):
        outcome = await asyncio.to_thread(ask, tmp_path, request)
    assert outcome == CommandOutcome(accepted=False, reason="no alarm is named 'nothing'", code="C05")
    assert desk.told[0][0] == request.command(request.verb)


@pytest.mark.parametrize(
    ("line", "why"),
    [
        (b"hello\n", "not valid"),
        (b"\n", "not valid"),
        (b"[]\n", "not valid"),
        (b"\xff\xfe\n", "not valid"),
        (b"null\n", "not valid"),
        (wish(schema="daqsvc.control/2"), "schema"),
        (
            wish(verb="delete"),
            "'unbypass'; or a question exactly as documented: 'status', 'live', 'reload'",
        ),
        (wish(verb=None), "verb"),
        (wish(alarm=""), "alarm"),
        (wish(alarm=7), "alarm"),
        (wish(alarm="a" * 201), "alarm"),
        (wish(by=""), "by"),
        (wish(by="ann\x1b[2J"), "by"),
        (wish(reason="one\ntwo"), "reason"),
        (wish(reason="r" * 501), "reason"),
        (wish(duration_s=-1), "duration_s"),
        (wish(duration_s=float("nan")), "duration_s"),
        (wish(duration_s=float("inf")), "duration_s"),
        (wish(duration_s="1800"), "duration_s"),
        (wish(colour="red"), "colour"),
        (wish(machine="pump"), "this service watches 'laval-rig', not 'pump'"),
        (json.dumps(wish()).encode()[:-1] + b', "by": "eve"}\n', "key 'by' is there twice; write it once"),
        (b'{"a":' * 2000 + b"\n", "not valid"),
        (b"x" * 20_000 + b"\n", "longer than 16384 bytes"),
        (b"x" * 200_000, "longer than 16384 bytes"),
    ],
)
async def test_what_is_no_request_is_refused_with_the_reason_counted_and_does_nothing(
    line: bytes | dict[str, Any], why: str, tmp_path: Path
) -> None:
    desk = Desk()
    async with serving(tmp_path, desk) as server:
        sent = line if isinstance(line, bytes) else json.dumps(line).encode() + b"\n"
        answer = await say(server, sent)
        assert answer["accepted"] is False
        assert why in answer["reason"]
        assert answer["code"] == ("C04" if "watches" in why else "C07")
        if why == "colour":
            had("C07", answer["reason"])
        assert len(answer["reason"].splitlines()) == 1
        assert (server.counters.malformed, server.counters.requests) == (1, 0)
        assert not desk.told
        assert (await say(server, json.dumps(wish()).encode() + b"\n"))["accepted"], "the next one is served"


async def test_a_client_may_ask_again_on_the_same_connection(tmp_path: Path) -> None:
    async with serving(tmp_path) as server:
        reader, writer = await asyncio.open_unix_connection(server.path)
        for line in (b"hello\n", json.dumps(wish()).encode() + b"\n"):
            writer.write(line)
        answers = [json.loads(await reader.readline())["accepted"] for _ in range(2)]
        writer.close()
    assert answers == [False, True]


async def test_half_a_request_is_not_obeyed_however_whole_it_looks(tmp_path: Path) -> None:
    desk = Desk()
    async with serving(tmp_path, desk) as server:
        _, writer = await asyncio.open_unix_connection(server.path)
        writer.write(json.dumps(wish()).encode())
        writer.close()
        await eventually(lambda: server.counters.clients_given_up == 1, "the client is given up")
    assert not desk.told


async def test_a_client_that_says_nothing_is_given_up(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(control, "PATIENCE_S", 0.05)
    async with serving(tmp_path) as server:
        reader, writer = await asyncio.open_unix_connection(server.path)
        writer.write(b'{"schema"')
        assert await reader.read() == b""
        assert server.counters.clients_given_up == 1
        writer.close()


async def test_a_client_that_never_reads_its_answers_is_given_up(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(control, "PATIENCE_S", 0.2)
    async with serving(tmp_path) as server:
        with socket.socket(socket.AF_UNIX) as deaf:
            deaf.setblocking(False)
            deaf.connect(os.fspath(server.path))
            with contextlib.suppress(OSError):
                while not server.counters.clients_given_up:
                    with contextlib.suppress(BlockingIOError):
                        deaf.send(b"x\n" * 1000)
                    await asyncio.sleep(0.001)
        assert server.counters.clients_given_up == 1


async def test_idle_clients_of_a_user_make_way_for_the_next_one(tmp_path: Path) -> None:
    async with serving(tmp_path) as server:
        hanging = [await asyncio.open_unix_connection(server.path) for _ in range(3 * control.MOST_CLIENTS)]
        for _, writer in hanging:
            writer.write(b'{"half')
        assert (await say(server, json.dumps(wish()).encode() + b"\n"))["accepted"], (
            "there is room for one more"
        )
        assert len(server._clients) <= control.MOST_CLIENTS
        assert server.counters.clients_displaced == 2 * control.MOST_CLIENTS + 1
        for _, writer in hanging:
            writer.close()


async def test_clients_with_a_request_under_way_do_not_make_way(tmp_path: Path) -> None:
    desk = Desk()
    desk.may_answer.clear()
    async with serving(tmp_path, desk) as server:
        busy = [await asyncio.open_unix_connection(server.path) for _ in range(control.MOST_CLIENTS)]
        for _, writer in busy:
            writer.write(json.dumps(wish()).encode() + b"\n")
        await eventually(lambda: len(desk.told) == control.MOST_CLIENTS, "all of them have asked")
        reader, writer = await asyncio.open_unix_connection(server.path)
        assert await reader.read() == b""
        assert server.counters.clients_turned_away == 1
        desk.may_answer.set()
        for answers, _ in busy:
            assert json.loads(await answers.readline())["accepted"]
        for _, each in [*busy, (reader, writer)]:
            each.close()


async def test_clients_of_one_user_keep_no_other_user_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    desk = Desk()
    desk.may_answer.clear()
    async with serving(tmp_path, desk) as server:
        monkeypatch.setattr(control, "_peer", lambda _: (NOBODY, 7))
        busy = [await asyncio.open_unix_connection(server.path) for _ in range(control.MOST_CLIENTS)]
        for _, writer in busy:
            writer.write(json.dumps(wish()).encode() + b"\n")
        await eventually(lambda: len(desk.told) == control.MOST_CLIENTS, "all of them have asked")
        monkeypatch.setattr(control, "_peer", lambda _: (0, 8))
        desk.may_answer.set()
        assert (await say(server, json.dumps(wish()).encode() + b"\n"))["accepted"]
        assert desk.told[-1][1] == "local uid 0 pid 8"
        assert (server.counters.clients_displaced, server.counters.clients_turned_away) == (0, 0)
        for _, each in busy:
            each.close()


async def test_a_mistake_in_carrying_out_costs_one_connection(tmp_path: Path) -> None:
    async def fail(_command: AlarmCommand, _source: str) -> CommandOutcome:
        raise RuntimeError("a mistake")

    server = ControlServer(tmp_path, (MACHINE,), fail)
    await server.open()
    try:
        reader, writer = await asyncio.open_unix_connection(server.path)
        writer.write(json.dumps(wish()).encode() + b"\n")
        assert await reader.read() == b""
        writer.close()
        assert server.counters.clients_failed == 1
        assert (await say(server, b"?\n"))["accepted"] is False, "the next one is served"
    finally:
        await server.close()


async def test_a_socket_that_is_taken_away_or_cannot_be_made_comes_back(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(control, "LOOK_S", 0.01)
    (tmp_path / "control.sock").write_text("in the way")
    server = ControlServer(tmp_path, (MACHINE,), Desk())
    serving = asyncio.create_task(server.serve())
    await asyncio.sleep(0.05)
    for _ in range(2):
        (tmp_path / "control.sock").unlink()
        await eventually(lambda: server.path.exists() and server._inode, "there is a socket")
        await eventually(lambda: server._server is not None, "somebody listens")
        assert (await say(server, json.dumps(wish()).encode() + b"\n"))["accepted"]
    serving.cancel()
    await asyncio.wait({serving})
    assert not server.path.exists()


@pytest.mark.gives("S12")
async def test_a_link_that_is_taken_away_is_made_again_and_why_not_is_said_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(control, "LOOK_S", 0.01)
    store, runtime = tmp_path / "store", tmp_path / "run"
    store.mkdir()
    runtime.mkdir()
    link = store / "control.sock"
    server = ControlServer(store, (MACHINE,), Desk(), lambda: 7, runtime)
    await server.open()
    inode = server._inode
    serving = asyncio.create_task(server.serve())
    try:
        link.unlink()
        await eventually(link.is_symlink, "there is a link")
        assert await asyncio.to_thread(events_waiting, store) == 7
        link.unlink()
        link.write_text("in the way")
        await eventually(lambda: "none can be made" in caplog.text, "it is said")
        await asyncio.sleep(0.1)
        link.unlink()
        await eventually(link.is_symlink, "there is a link again")
        await eventually(lambda: caplog.messages[-1].endswith("is made again"), "that is said as well")
    finally:
        serving.cancel()
        await asyncio.wait({serving})
    assert server._inode == inode, "the socket was none the worse for it"
    again = f"the link {link} to the control socket was removed; it is made again"
    first, why, *rest = caplog.messages
    assert (
        f"{link} is not a socket, and no control socket can be made there; move it to another "
        f"place; that is tried again" in why
    )
    assert [first, *rest] == [again, again]


async def test_why_the_socket_cannot_be_made_is_said_once_by_whoever_learns_it_first(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(control, "LOOK_S", 0.01)
    monkeypatch.setattr("daqsvc.acquisition.link.Backoff.next_ns", lambda _: 1_000_000)
    (tmp_path / "control.sock").write_text("in the way")
    server = ControlServer(tmp_path, (MACHINE,), Desk())
    with pytest.raises(ControlError):
        await server.open()
    serving = asyncio.create_task(server.serve())
    await asyncio.sleep(0.05)
    assert not caplog.messages, "the caller of `open` has said it"
    for _ in range(2):
        (tmp_path / "control.sock").unlink()
        await eventually(lambda: server._server is not None, "there is a socket")
        (tmp_path / "control.sock").unlink()
        (tmp_path / "control.sock").write_text("in the way")
        await eventually(lambda: "until this is corrected" in caplog.text, "it is said")
        await asyncio.sleep(0.05)
        assert caplog.text.count("until this is corrected") == 1
        caplog.clear()
    serving.cancel()
    await asyncio.wait({serving})


async def test_a_store_that_can_no_longer_be_written_is_one_line_at_the_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def refuse(_path: Path, _inode: int | None) -> None:
        raise OSError(errno.EROFS, os.strerror(errno.EROFS))

    async with serving(tmp_path):
        monkeypatch.setattr(control, "_remove", refuse)
    (said,) = [record.getMessage() for record in caplog.records]
    assert said.endswith("is left behind, where the next start replaces it: Read-only file system")


async def test_nothing_is_left_of_it_and_nobody_is_waited_for_when_it_closes(tmp_path: Path) -> None:
    desk = Desk()
    desk.may_answer.clear()
    async with serving(tmp_path, desk) as server:
        assert stat.S_IMODE(server.path.stat().st_mode) == 0o600
        idle_reader, idle_writer = await asyncio.open_unix_connection(server.path)
        reader, writer = await asyncio.open_unix_connection(server.path)
        writer.write(json.dumps(wish()).encode() + b"\n")
        await eventually(lambda: desk.told, "the command has come")
    assert not any(tmp_path.iterdir())  # noqa: ASYNC240
    assert await reader.read() == await idle_reader.read() == b""
    for each in (writer, idle_writer):
        each.close()


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can become somebody else")
async def test_nobody_but_its_own_user_may_command_the_service() -> None:
    with tempfile.TemporaryDirectory(prefix="daqsvc-test-") as name:
        store = Path(name)
        store.chmod(0o755)  # noqa: ASYNC240
        desk = Desk()
        async with serving(store, desk) as server:
            os.seteuid(NOBODY)
            try:
                with pytest.raises(ControlError, match="takes commands from its own user and from root only"):
                    ask(store, RESET)
                with pytest.raises(ControlError, match="try again with sudo") as refused:
                    ask_status(store)
                assert not isinstance(refused.value, AbsentError), "asking again would not help"
                assert refused.value.code.id == "C07"
            finally:
                os.seteuid(0)
            assert (server.counters.clients, desk.told) == (0, [])


async def test_a_socket_that_a_killed_service_left_is_replaced(tmp_path: Path) -> None:
    with socket.socket(socket.AF_UNIX) as dead:
        dead.bind(os.fspath(tmp_path / "control.sock"))
    with pytest.raises(ControlError, match=r"no daqsvc runs on the store .* --store"):
        await asyncio.to_thread(ask, tmp_path, RESET)
    with pytest.raises(AbsentError, match=r"no daqsvc runs on the store .* --store"):
        await asyncio.to_thread(ask_status, tmp_path)
    async with serving(tmp_path) as server:
        assert (await say(server, json.dumps(wish()).encode() + b"\n"))["accepted"]


async def test_a_socket_elsewhere_is_found_from_the_store(tmp_path: Path) -> None:
    store, runtime = tmp_path / "store", tmp_path / "run"
    store.mkdir()
    runtime.mkdir()
    for _ in range(2):  # a link that was left over is no matter, nor a socket of a start without systemd
        server = ControlServer(store, (MACHINE,), Desk(), lambda: 7, runtime)
        await server.open()
        try:
            assert stat.S_ISSOCK((runtime / "control.sock").lstat().st_mode)
            assert await asyncio.to_thread(events_waiting, store) == 7
        finally:
            await server.close()
        assert not (runtime / "control.sock").exists()
        with pytest.raises(ControlError, match="no daqsvc runs"):
            events_waiting(store)
        async with serving(store) as plain:
            assert plain.path.is_socket()
            assert not plain.path.is_symlink()


async def test_what_waits_in_memory_is_told_to_who_asks(tmp_path: Path) -> None:
    server = ControlServer(tmp_path, (MACHINE,), Desk(), lambda: 7)
    await server.open()
    try:
        assert await asyncio.to_thread(events_waiting, tmp_path) == 7
    finally:
        await server.close()
    with pytest.raises(ControlError, match="no daqsvc runs"):
        events_waiting(tmp_path)


async def test_what_is_in_the_way_and_no_socket_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "control.sock").write_text("precious")
    with pytest.raises(ControlError, match=r"control\.sock is not a socket"):
        await ControlServer(tmp_path, (MACHINE,), Desk()).open()
    assert (tmp_path / "control.sock").read_text() == "precious"


async def test_a_path_longer_than_an_address_is_no_matter(tmp_path: Path) -> None:
    store = tmp_path / ("long" * 30)
    store.mkdir()
    async with serving(store) as server:
        assert (await asyncio.to_thread(ask, store, RESET)).accepted
        assert server.path.exists()
    assert not server.path.exists()
    with pytest.raises(ControlError, match="no daqsvc runs"):
        ask(store, RESET)


@pytest.mark.parametrize("answer", [b"", b"what?\n", b'{"accepted": true}'])
async def test_a_service_that_dies_before_its_answer_is_told(answer: bytes, tmp_path: Path) -> None:
    async def hang_up(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        await reader.readline()
        writer.write(answer)
        writer.close()

    server = await asyncio.start_unix_server(hang_up, tmp_path / "control.sock")
    with pytest.raises(ControlError, match="daqsvc alarms shows whether it was carried out"):
        await asyncio.to_thread(ask, tmp_path, RESET)
    server.close()
    await server.wait_closed()


def test_a_service_that_does_not_answer_is_told(tmp_path: Path) -> None:
    with socket.socket(socket.AF_UNIX) as mute:
        mute.bind(os.fspath(tmp_path / "control.sock"))
        mute.listen()
        with pytest.raises(ControlError, match=r"has not answered within 0\.05 s"):
            ask(tmp_path, RESET, timeout_s=0.05)


def test_what_cannot_be_asked_is_said_in_our_words_only() -> None:
    with pytest.raises(ControlError) as refused:
        request_of(AlarmCommand(verb=Verb.ACKNOWLEDGE, alarm="\udcff", by="Ada"), None)
    assert f"{refused.value}".startswith("that cannot be asked, alarm: must be printable")


def test_a_lock_of_the_same_inode_number_on_another_disk_is_somebody_elses(tmp_path: Path) -> None:
    with mounted(tmp_path / "one", "1m") as one, mounted(tmp_path / "other", "1m") as other:
        locks = [disk.directory / "outbox.sqlite.lock" for disk in (one, other)]
        for lock in locks:
            lock.touch()
        assert locks[0].stat().st_ino == locks[1].stat().st_ino
        with take_possession(locks[0]):
            assert [is_possessed(lock) for lock in locks] == [True, False]
        assert not is_possessed(locks[0])


async def test_a_service_without_its_socket_is_not_said_to_be_away(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """As on a store that is read-only: the service runs and watches, but can make no socket there."""
    with mounted(tmp_path / "disk", "4m") as disk:
        store = disk.directory / "store"
        limits = OutboxLimits(reserve_bytes=0, ballast_bytes=0)
        outbox = Outbox(store / "outbox.sqlite", SystemClock(), limits)
        await outbox.open()
        await outbox.close()
        disk.refuse_writes()
        with pytest.raises(ControlError, match="no daqsvc runs"):
            await asyncio.to_thread(ask, store, RESET)
        outbox = Outbox(store / "outbox.sqlite", SystemClock(), limits)
        await outbox.open()
        try:
            with pytest.raises(UnreachableError, match=r"runs, but has no control socket .* read-only"):
                await asyncio.to_thread(ask, store, RESET)
            assert await asyncio.to_thread(main, ["alarms", "--store", str(store)]) == 0
            said = capsys.readouterr().err
            assert "the journal cannot be written, so this may not be their present state" in said
        finally:
            await outbox.close()


async def test_a_service_that_is_killed_meanwhile_is_said_in_plain_words(tmp_path: Path) -> None:
    async def end(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        await reader.readline()
        writer.close()

    server = await asyncio.start_unix_server(end, tmp_path / "control.sock")
    try:
        with pytest.raises(AbsentError) as told:
            await asyncio.to_thread(ask_snapshot, tmp_path)
    finally:
        server.close()
        await server.wait_closed()
    assert f"{told.value}" == (
        f"the daqsvc of {tmp_path} has closed the connection without an answer; its log shows what it has "
        "done"
    )
