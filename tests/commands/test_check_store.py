"""What `daqsvc check` says of a store that `daqsvc run` could not use, and how `run` ends then."""

from __future__ import annotations

import asyncio
import contextlib
import os
import re
import sqlite3
import subprocess
import sys
import tempfile
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, BinaryIO

import pytest
from support.given_codes import had
from support.live_service import running
from support.machine_files import LAVAL, parsed
from support.paths import ROOT

from daqsvc.box import Box
from daqsvc.cli import main
from daqsvc.commands import run as run_command
from daqsvc.commands.service_manager import ServiceManager
from daqsvc.control import ask_status
from daqsvc.detectors.make import detectors
from daqsvc.outbox.files import take_possession
from daqsvc.settings import load_machine_file

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    Check = Callable[[Path], tuple[int, str, str]]

MACHINE = ROOT / "config" / "machines" / "bearing.toml"
NOBODY = 65_534


@pytest.fixture
def machine(tmp_path: Path) -> Callable[[Path], Path]:
    """A machine file with a store."""

    def written(store: Path) -> Path:
        file = tmp_path / "machine.toml"
        text = re.sub('(?m)^directory = ".*"$', f'directory = "{store}"', MACHINE.read_text())
        file.write_text(text)
        return file

    return written


@pytest.fixture
def check(machine: Callable[[Path], Path], capsys: pytest.CaptureFixture[str]) -> Check:
    def checked(store: Path) -> tuple[int, str, str]:
        code = main(["check", str(machine(store))])
        out, err = capsys.readouterr()
        return code, " ".join(out.split()), err.strip()

    return checked


def run(machine: Path, store: Path | None = None) -> int:
    """The exit code of a service that does not get far."""
    guard: Any = SimpleNamespace(
        stopping=None, protect=lambda _: None, stop_by=lambda *_: None, expect_turns=lambda _: None
    )
    return run_command._run(Box.single(load_machine_file(machine)), [machine], store, guard, ServiceManager())


def test_a_store_that_is_a_file_or_below_one_is_refused_by_check_and_run(
    tmp_path: Path, machine: Callable[[Path], Path], check: Check, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / "alarms").write_text("")
    for store, said in (
        (
            tmp_path / "alarms",
            f"the store {tmp_path}/alarms is no directory, but a file: name a directory in",
        ),
        (tmp_path / "alarms" / "pump", f"{tmp_path}/alarms, above the store {tmp_path}/alarms/pump, is no"),
    ):
        code, out, err = check(store)
        assert (code, out) == (2, "")
        assert f"machine.toml: store.directory = '{store}': {said}" in err
        assert run(machine(store)) == run(MACHINE, store) == 2
        assert caplog.text.count(said) == 2


def test_a_store_of_a_newer_version_is_refused_for_good_and_left_as_it_is(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    store = tmp_path / "alarms"
    store.mkdir(mode=0o700)
    with contextlib.closing(sqlite3.connect(store / "outbox.sqlite")) as newer:
        newer.execute("PRAGMA journal_mode = WAL")
        newer.execute("PRAGMA user_version = 99")
    (store / "outbox.sqlite.version").write_text("9.9.0\n")
    before = (store / "outbox.sqlite").read_bytes()
    assert run(MACHINE, store) == 2
    assert "written by daqsvc 9.9.0" in caplog.text
    assert "install that version again" in caplog.text
    assert (store / "outbox.sqlite").read_bytes() == before
    assert (store / "outbox.sqlite.version").read_text() == "9.9.0\n"


def newer(store: Path) -> None:
    """Have a version of the future write a store."""
    store.mkdir(mode=0o700)
    with contextlib.closing(sqlite3.connect(store / "outbox.sqlite")) as file:
        file.execute("PRAGMA user_version = 99")
    (store / "outbox.sqlite.version").write_text("9.9.0\n")


def test_check_says_that_a_newer_version_has_written_the_store(tmp_path: Path, check: Check) -> None:
    newer(tmp_path / "alarms")
    code, out, err = check(tmp_path / "alarms")
    assert (code, out) == (2, ""), "as daqsvc run ends"
    assert f"machine.toml: store.directory = '{tmp_path}/alarms': " in err
    assert "has schema version 99, written by daqsvc 9.9.0; this is daqsvc" in err


def taken(store: Path) -> contextlib.closing[BinaryIO]:
    """Have another service use a store."""
    store.mkdir(mode=0o700)
    return contextlib.closing(take_possession(store / "outbox.sqlite.lock"))


@pytest.mark.parametrize(
    ("spoilt", "code", "said"),
    [
        (newer, 2, "written by daqsvc 9.9.0"),
        (taken, 1, "another daqsvc uses the store"),
        (Path.touch, 2, "is no directory, but a file"),
    ],
)
def test_a_store_that_cannot_be_used_is_refused_before_any_kernel_is_compiled(
    spoilt: Callable[[Path], Any], code: int, said: str, tmp_path: Path
) -> None:
    """On a small box that takes minutes, and systemd may have given up meanwhile."""
    store, kernels = tmp_path / "alarms", tmp_path / "kernels"
    with spoilt(store) or contextlib.nullcontext():
        ended = subprocess.run(
            [sys.executable, "-m", "daqsvc", "run", MACHINE, "--store", store],
            env={**os.environ, "NUMBA_CACHE_DIR": f"{kernels}"},
            capture_output=True,
            text=True,
            check=False,
            cwd=ROOT,
        )
    assert ended.returncode == code, ended.stderr
    assert said in ended.stderr
    assert len(ended.stderr.splitlines()) == 1
    assert not [path for path in kernels.rglob("*") if path.is_file()]


@pytest.mark.parametrize(("name", "code"), [("laval-rig", 1), ("pump", 2)])
async def test_a_store_in_use_is_tried_again_only_by_a_service_of_the_same_machine(
    name: str, code: int, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Its turn comes when the other one ends; that of another machine would be started again for ever."""
    first = parsed(LAVAL, ('interface = "socketcan"', 'interface = "virtual"'))
    second = tmp_path / "second.toml"
    second.write_text(LAVAL.read_text().replace('name = "laval-rig"', f'name = "{name}"'))
    store = tmp_path / "store"
    async with running(first, store):
        assert await asyncio.to_thread(run, second, store) == code
        [status] = await asyncio.to_thread(ask_status, store)
    assert f"another daqsvc uses the store {store}; stop it if it watches the same machine" in caplog.text
    assert status["machine"] == "laval-rig"


def test_a_store_that_this_account_cannot_use_is_a_warning(tmp_path: Path, check: Check) -> None:
    store = tmp_path / "alarms"
    code, out, _ = check(store)
    assert (code, "Warnings" in out) == (0, False), "it is made at the start"
    store.mkdir(mode=0o700)
    assert "Warnings" not in check(store)[1]
    store.chmod(0o777)
    assert run(MACHINE, store) == 2
    code, out, err = check(store)
    assert (code, err) == (0, "")
    assert (
        f"Warnings: 1 {tmp_path}/machine.toml: store.directory = '{store}': daqsvc run could not start" in out
    )
    assert f"the store {store} has mode 0777, so that others may put files of theirs into it" in out


def test_a_store_that_may_not_be_written_is_a_warning(
    tmp_path: Path, check: Check, monkeypatch: pytest.MonkeyPatch
) -> None:
    store = tmp_path / "alarms"
    store.mkdir(mode=0o700)
    allowed = os.access
    monkeypatch.setattr(os, "access", lambda path, mode, **_: path != store and allowed(path, mode))
    code, out, _ = check(store)
    assert code == 0
    assert f"the store {store} may not be written by" in out
    assert run(MACHINE, store) == 2
    monkeypatch.undo()
    monkeypatch.setattr("daqsvc.outbox.safety.is_read_only", lambda path: path == store)
    monkeypatch.setattr("daqsvc.outbox.files.is_read_only", lambda path: path == store)
    code, out, _ = check(store)
    assert code == 0
    assert "daqsvc run would keep the alarms in memory only, and lose them at its end: the store" in out
    assert f"the store {store} cannot be written: " in out
    assert "could not start" not in out


@pytest.fixture
def owned() -> Iterator[Path]:
    """A store of the service's own account, where that can get at it."""
    with tempfile.TemporaryDirectory() as folder:
        Path(folder).chmod(0o755)
        store = Path(folder) / "alarms"
        store.mkdir(mode=0o700)
        os.chown(store, NOBODY, NOBODY)
        yield store


is_root = pytest.mark.skipif(os.geteuid() != 0, reason="only root can give files away")


@is_root
def test_root_is_told_how_the_service_of_another_account_stands_with_its_store(
    owned: Path, check: Check, caplog: pytest.LogCaptureFixture
) -> None:
    code, out, err = check(owned)
    assert (code, err, "Warnings" in out) == (0, "", False), "the service's account may use it"
    assert (os.geteuid(), os.getegid()) == (0, 0)
    # Whoever runs the service as root is not told to take the store away from its account.
    assert run(MACHINE, owned) == 2
    said = f"the store {owned} belongs to nobody and the service runs as root: run the service as nobody, or"
    assert said in caplog.text
    newer_file = owned / "outbox.sqlite"
    with contextlib.closing(sqlite3.connect(newer_file)) as file:
        file.execute("PRAGMA user_version = 99")
    for owner in (NOBODY, 0):  # as it should be, and a copy that only root can read
        os.chown(newer_file, owner, owner)
        newer_file.chmod(0o600)
        code, out, err = check(owned)
        assert (code, out) == (2, "")
        assert "has schema version 99" in err


@is_root
@pytest.mark.parametrize("kind", ["a stranger's", "a stranger's, where root may be nobody else", "root's"])
def test_root_opens_no_store_with_sqlite_where_others_may_put_files(
    kind: str, owned: Path, check: Check, monkeypatch: pytest.MonkeyPatch
) -> None:
    """SQLite opens by name, and its owner may have put a link there by then."""
    with contextlib.closing(sqlite3.connect(owned / "outbox.sqlite")) as file:
        file.execute("PRAGMA user_version = 2")
    for path in (owned / "outbox.sqlite", owned):
        os.chown(path, *((0, 0) if kind == "root's" else (NOBODY, NOBODY)))
    (owned / "outbox.sqlite-wal").write_bytes(b"log")
    os.chown(owned / "outbox.sqlite-wal", *((0, 0) if kind == "root's" else (NOBODY, NOBODY)))
    owned.chmod(0o777)
    who = []
    connect: Any = sqlite3.connect
    seteuid = os.seteuid

    def connected(*arguments: Any, **how: Any) -> Any:
        who.append(os.geteuid())
        return connect(*arguments, **how)

    def refused(user: int) -> None:
        raise PermissionError(user)

    monkeypatch.setattr(sqlite3, "connect", connected)
    monkeypatch.setattr(os, "seteuid", refused if "nobody else" in kind else seteuid)
    code, out, err = check(owned)
    monkeypatch.undo()
    assert (code, err) == (0, "")
    assert "could not start as" in out
    assert 0 not in who
    assert bool(who) == (kind == "a stranger's"), "its owner's rights are enough"
    # Root sees all the same whose version it is.
    with contextlib.closing(sqlite3.connect(owned / "outbox.sqlite")) as file:
        file.execute("PRAGMA user_version = 99")
    assert "has schema version 99" in check(owned)[2]


@is_root
def test_the_owner_of_a_store_has_not_the_group_that_chown_has_left_to_root(
    owned: Path, check: Check
) -> None:
    """`check` would pass what `run` refuses: a file that root's group may write."""
    (owned / "outbox.sqlite").touch()
    (owned / "outbox.sqlite").chmod(0o660)
    os.chown(owned, NOBODY, 0)
    code, out, err = check(owned)
    assert (code, err) == (0, "")
    assert f"could not start as nobody: {owned}/outbox.sqlite belongs to root, and the user of the" in out


def test_what_a_store_says_of_itself_does_nothing_to_a_terminal(tmp_path: Path, check: Check) -> None:
    store = tmp_path / "alarms"
    newer(store)
    (store / "outbox.sqlite.version").write_text("\x1b]0;x\x07 9.9.0\n")
    assert check(store)[2].isprintable()
    (store / "outbox.sqlite").unlink()
    (store / "outbox.sqlite").symlink_to("\x1b[2J")
    out = check(store)[1]
    assert "is a symbolic link of" in out
    assert out.isprintable()


@is_root
def test_a_copy_of_a_store_that_belongs_to_root_is_a_warning_with_its_remedy(
    owned: Path, check: Check
) -> None:
    (owned / "outbox.sqlite").touch(0o600)
    code, out, err = check(owned)
    assert (code, err) == (0, "")
    assert f"could not start as nobody: {owned}/outbox.sqlite belongs to root, and the user of the" in out
    assert f"chown -R nobody {owned}" in out
    assert "[S02]" in out
    had("S02", out.partition("Warnings: 1 ")[2])


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can be somebody else for a while")
def test_detectors_leave_it_to_the_outbox_to_refuse_a_store_that_may_not_be_searched(tmp_path: Path) -> None:
    for file in (MACHINE, LAVAL):
        machine = load_machine_file(file)
        there = [type(detector) for detector in detectors(machine, tmp_path)]
        os.seteuid(NOBODY)
        try:
            assert [type(detector) for detector in detectors(machine, tmp_path)] == there
        finally:
            os.seteuid(0)


def test_a_store_where_no_directory_can_be_made_is_not_tried_again_and_again(
    caplog: pytest.LogCaptureFixture,
) -> None:
    assert run(MACHINE, Path("/proc/alarms")) == 2
    said = "the store /proc/alarms cannot be made there: name another in [store] of the machine file, or with"
    assert caplog.messages == [f"{said} --store"]


def test_an_account_without_a_place_for_a_store_is_not_started_again_and_again(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    def homeless() -> Path:
        raise RuntimeError("Could not determine home directory.")

    for variable in ("STATE_DIRECTORY", "XDG_STATE_HOME"):
        monkeypatch.delenv(variable, raising=False)
    monkeypatch.setattr(Path, "home", homeless)
    (tmp_path / "machine.toml").write_text(MACHINE.read_text().partition("[store]")[0])
    assert run(tmp_path / "machine.toml") == 2
    assert "has no home directory for the alarm journal: name one with --store" in caplog.text
