"""A store that others may write to is refused, with who owns it and what to do; links are not followed."""

from __future__ import annotations

import os
import re
import stat
import tempfile
from contextlib import contextmanager
from pathlib import Path

import pytest
from support.paths import ROOT

from daqsvc.acquisition.clock import SystemClock
from daqsvc.alarms.commands import AlarmCommand, Verb
from daqsvc.audit import AuditError, AuditLog
from daqsvc.commands.alarm_journal import current
from daqsvc.outbox.files import is_read_only, remedy
from daqsvc.outbox.journal import Journal
from daqsvc.outbox.limits import OutboxLimits
from daqsvc.outbox.messages import OutboxError, StoreRefusedError
from daqsvc.outbox.reading import read_journal
from daqsvc.outbox.safety import as_owner_of, refuse_unopenable
from daqsvc.outbox.store import Outbox

STRANGER = 61234

is_root = pytest.mark.skipif(os.geteuid() != 0, reason="only root can give files away")


def opened(store):
    journal = Journal(
        store / "outbox.sqlite", lambda: 10**18, OutboxLimits(ballast_bytes=4096, reserve_bytes=0)
    )
    journal.open()
    return journal


@contextmanager
def refused(store, *words):
    with pytest.raises(OutboxError) as caught:
        opened(store)
    for word in words:
        assert word in str(caught.value)
    yield


@pytest.fixture
def searched():
    """A directory that every user may search, unlike those of pytest, with above/store in it."""
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "above" / "store").mkdir(parents=True)
        Path(folder).chmod(0o755)
        yield Path(folder)


@pytest.fixture
def _anything_goes():
    before = os.umask(0)
    yield
    os.umask(before)


@pytest.mark.parametrize("mode", [0o777, 0o2777, 0o1777])
def test_a_volume_that_root_made_for_all_is_refused_with_what_helps_there(tmp_path, mode, monkeypatch):
    """An emptyDir of Kubernetes, and a service that is not root: chmod alone would lock it out."""
    if os.geteuid() != 0:
        pytest.skip("only root can make a directory of root's")
    volume = tmp_path / "volume"
    volume.mkdir()
    volume.chmod(mode)
    monkeypatch.setattr(os, "geteuid", lambda: 4711)
    owned = f"chown 4711 {volume} && chmod 700 {volume}, as root (on Kubernetes: in an init container)"
    with refused(volume, f"the store {volume} has mode {mode:04o}", owned):
        pass
    if mode & stat.S_ISVTX:
        opened(volume / "store").close()
    else:
        with refused(volume / "store", f"{volume}, above the store", f"chmod go-w {volume}, or chmod +t it"):
            pass


@pytest.mark.usefixtures("_anything_goes")
def test_a_new_store_is_its_owners_alone_whatever_the_umask(tmp_path):
    store = tmp_path / "above" / "store"
    journal = opened(store)
    journal.close()
    assert stat.S_IMODE(store.stat().st_mode) == 0o700
    assert stat.S_IMODE(store.parent.stat().st_mode) == 0o755
    assert {stat.S_IMODE(path.stat().st_mode) for path in store.iterdir()} == {0o600}


@pytest.mark.parametrize("mode", [0o777, 0o757, 0o1777])
def test_a_store_that_others_may_write_is_refused(tmp_path, mode):
    store = tmp_path / "store"
    store.mkdir()
    store.chmod(mode)
    with refused(store, f"mode {mode:04o}", f"chmod go-w {store}"):
        assert list(store.iterdir()) == []


@is_root
def test_a_store_for_a_group_of_others_is_refused_and_for_ones_own_is_not(tmp_path):
    store = tmp_path / "store"
    store.mkdir()
    store.chmod(0o770)
    opened(store).close()
    os.chown(store, 0, STRANGER)
    with refused(store, "mode 0770"):
        pass


def test_a_store_below_what_others_may_write_is_refused_unless_names_are_kept_there(tmp_path):
    (tmp_path / "shared").mkdir()
    (tmp_path / "shared").chmod(0o777)
    with refused(tmp_path / "shared" / "store", "above the store", "mode 0777"):
        pass
    (tmp_path / "shared").chmod(0o1777)
    opened(tmp_path / "shared" / "store").close()


@is_root
@pytest.mark.parametrize("whose", ["the store", "above", "a file"])
def test_what_belongs_to_another_user_is_refused(tmp_path, whose):
    store = tmp_path / "above" / "store"
    opened(store).close()
    path = {"the store": store, "above": store.parent, "a file": store / "outbox.sqlite"}[whose]
    os.chown(path, STRANGER, 0)
    with refused(store, f"belongs to user {STRANGER}", "runs as root", str(path)):
        pass


@is_root
@pytest.mark.parametrize(
    ("directory", "owner", "mode", "said"),
    [
        (
            "above/store",
            STRANGER + 1,
            0o700,
            "/store belongs to user 61235 and the service runs as user 61234",
        ),
        ("above", STRANGER + 1, 0o700, "/above, above the store "),
        ("above/store", STRANGER, 0o500, "/store may not be written by user 61234: chmod u+rwx "),
        ("above/store", STRANGER, 0o000, "/store may not be written by user 61234: chmod u+rwx "),
        (
            "above/store",
            0,
            0o700,
            "/store may not be written by user 61234: it belongs to root and has mode 0700: chown -R 61234 ",
        ),
        ("above/store", 0, 0o755, "it belongs to root and has mode 0755: chown -R 61234 "),
        ("above", 0, 0o700, "cannot open the outbox "),
    ],
)
async def test_a_store_that_this_account_may_not_use_is_refused_for_good(
    directory, owner, mode, said, searched
):
    (searched / directory).chmod(mode)
    os.chown(searched / directory, owner, owner)
    outbox = Outbox(searched / "above" / "store" / "outbox.sqlite", SystemClock())
    os.seteuid(STRANGER)
    try:
        with pytest.raises(StoreRefusedError, match=re.escape(said)):
            await outbox.open()
    finally:
        os.seteuid(0)
        await outbox.close()


def test_of_a_directory_that_is_not_there_the_one_above_tells_whether_it_can_be_made(tmp_path, monkeypatch):
    asked = os.statvfs

    def statvfs(path):
        told = list(asked(path))
        told[8] |= os.ST_RDONLY
        return os.statvfs_result(told)

    assert not is_read_only(tmp_path / "none" / "of" / "these")
    monkeypatch.setattr(os, "statvfs", statvfs)
    assert is_read_only(tmp_path / "none" / "of" / "these")
    assert "mount it writable again" in remedy(tmp_path / "none")


@is_root
@pytest.mark.parametrize(
    "name",
    [
        "outbox.sqlite",
        "outbox.sqlite-wal",
        "outbox.sqlite.sequence",
        "outbox.sqlite.lock",
        "outbox-telemetry.sqlite",
        "audit.jsonl",
    ],
)
async def test_a_file_of_roots_in_the_store_of_the_service_is_refused_before_anything_is_lost(name, searched):
    """So it is after `cp -r` by root. The service would go on without a journal, as on a disk that fails."""
    store = searched / "above" / "store"
    store.chmod(0o700)
    (store / name).touch(0o600)
    (store / "outbox.sqlite.bak").touch(0o600)
    os.chown(store, STRANGER, STRANGER)
    remedy_ = f"{name} belongs to root, and the user of the service, {STRANGER}, may not open it: chown -R"
    there = sorted(path.name for path in store.iterdir())
    for _ in range(2):
        outbox = Outbox(store / "outbox.sqlite", SystemClock())
        os.seteuid(STRANGER)
        try:
            with pytest.raises(StoreRefusedError, match=re.escape(f"{remedy_} {STRANGER} {store}")):
                await outbox.open()
        finally:
            os.seteuid(0)
            await outbox.close()
    assert sorted(path.name for path in store.iterdir()) == there
    os.chown(store / name, STRANGER, STRANGER)
    os.seteuid(STRANGER)
    try:
        refuse_unopenable(store)  # what an administrator keeps beside it is nobody's business
        (store / name).chmod(0)
        with pytest.raises(StoreRefusedError, match=re.escape(f"chmod u+rw {store / name}")):
            refuse_unopenable(store)
    finally:
        os.seteuid(0)


@is_root
def test_root_reads_the_store_of_the_service_as_its_owner_and_no_file_of_others(searched):
    store = searched / "above" / "store"
    opened(store).close()
    for path in (store, *store.iterdir()):
        os.chown(path, STRANGER, STRANGER)
    before = os.geteuid(), os.getegid(), os.getgroups()
    with as_owner_of(store):
        assert (os.geteuid(), os.getegid(), os.getgroups()) == (STRANGER, STRANGER, [STRANGER])
        assert read_journal(store).unsent == 0
    assert (os.geteuid(), os.getegid(), os.getgroups()) == before
    assert current(store) == []
    os.chown(store / "outbox.sqlite", 0, 0)
    with pytest.raises(
        OutboxError, match=f"belongs to root and its store to user {STRANGER}: chown -R {STRANGER} "
    ):
        current(store)
    os.chown(store / "outbox.sqlite", STRANGER + 1, STRANGER + 1)
    with pytest.raises(OutboxError, match=f"belongs to user {STRANGER + 1}"):
        read_journal(store)
    # The owner may be who attacks: a link to what only root may read.
    (searched / "secret").touch(0o600)
    (store / "outbox.sqlite").unlink()
    (store / "outbox.sqlite").symlink_to(searched / "secret")
    os.chown(store / "outbox.sqlite", STRANGER, STRANGER, follow_symlinks=False)
    for read in (read_journal, current):
        with pytest.raises(OutboxError, match="symbolic link"):
            read(store)
    with as_owner_of(store), pytest.raises(PermissionError):
        (store / "outbox.sqlite").read_bytes()


@is_root
@pytest.mark.parametrize(
    ("owner", "group", "has"), [(STRANGER, 0, 65_534), (65_534, 0, 65_534), (65_534, 7, 65_534)]
)
def test_the_owner_of_a_store_has_his_own_group_and_not_that_of_the_directory(searched, owner, group, has):
    """`chown daqsvc STORE`, as the remedies say, leaves it to root's group."""
    store = searched / "above" / "store"
    os.chown(store, owner, group)
    with as_owner_of(store):
        assert (os.geteuid(), os.getegid()) == (owner, has)
        assert 0 not in os.getgroups()
    assert (os.geteuid(), os.getegid()) == (0, 0)


@is_root
def test_a_link_of_another_user_is_not_gone_behind(tmp_path):
    opened(tmp_path / "real").close()
    link = tmp_path / "link"
    link.symlink_to(tmp_path / "real")
    opened(link).close()
    os.chown(link, STRANGER, STRANGER, follow_symlinks=False)
    with refused(link, f"a symbolic link of user {STRANGER}"):
        pass


@pytest.mark.parametrize(
    "name",
    [
        "outbox.sqlite",
        "outbox.sqlite-wal",
        "outbox.sqlite.sequence",
        "outbox.sqlite.lock",
        "outbox.sqlite.ballast",
    ],
)
def test_no_file_of_the_store_is_written_through_a_link(tmp_path, name):
    store, victim = tmp_path / "store", tmp_path / "victim"
    opened(store).close()
    victim.write_bytes(b"precious")
    (store / name).unlink(missing_ok=True)
    (store / name).symlink_to(victim)
    with refused(store, "symbolic link", str(victim), "remove it"):
        assert victim.read_bytes() == b"precious"


def test_a_link_is_not_read_either(tmp_path):
    opened(tmp_path / "real").close()
    (tmp_path / "store").mkdir()
    (tmp_path / "store" / "outbox.sqlite").symlink_to(tmp_path / "real" / "outbox.sqlite")
    with pytest.raises(OutboxError, match="symbolic link"):
        read_journal(tmp_path / "store")


@pytest.mark.parametrize("kind", ["link", "pipe"])
async def test_the_audit_log_is_a_file_of_its_own(tmp_path, kind):
    """A pipe would wait for a reader for ever."""
    path, victim = tmp_path / "audit.jsonl", tmp_path / "victim"
    if kind == "link":
        path.symlink_to(victim)
    else:
        os.mkfifo(path)
    with pytest.raises(
        AuditError, match="symbolic link" if kind == "link" else "no regular file|No such device"
    ):
        await AuditLog(path, SystemClock()).asked(AlarmCommand(verb=Verb.RESET, alarm="a", by="me"), "here")
    assert not victim.exists()


def test_no_document_has_a_store_where_everybody_may_write():
    root = ROOT
    files = [root / "README.md", *root.glob("docs/**/*.md"), *root.glob("config/**/*.toml")]
    for path in files:
        assert "--store /tmp" not in path.read_text(), path
