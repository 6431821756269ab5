"""Who may look at the page and who may act: accounts, sessions, proxies, and what is refused at the start."""

from __future__ import annotations

import io
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import pytest
from starlette.datastructures import Headers

from daqsvc.cli import main
from daqsvc.page.access.accounts import (
    AccountsError,
    AccountsFile,
    account_line,
    read_accounts,
    write_account,
)
from daqsvc.page.access.choice import AccessChoice, UnsafeError
from daqsvc.page.access.role import Role
from daqsvc.page.access.sessions import (
    IDLE_S,
    LONGEST_S,
    MOST,
    MOST_TRIERS,
    TRIES,
    TRY_EVERY_S,
    Sessions,
    Tries,
)
from daqsvc.page.access.ways import ByAccounts, ByProxy, OpenHere, SignInError

if TYPE_CHECKING:
    from pathlib import Path

PASSWORD = "correct horse"  # noqa: S105 - of a test


def asking(peer: str = "127.0.0.1", cookie: str = "", headers: list[tuple[str, str]] | None = None) -> Any:
    """A request of a browser."""
    raw = [(name.encode(), value.encode()) for name, value in headers or []]
    return SimpleNamespace(
        client=SimpleNamespace(host=peer),
        cookies={"daqsvc_page": cookie} if cookie else {},
        headers=Headers(raw=raw),
    )


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "accounts"
    write_account(path, "ann", account_line("ann", Role.OPERATOR, PASSWORD))
    return path


def test_only_the_password_opens_and_it_is_nowhere(file: Path) -> None:
    account = read_accounts(file)["ann"]
    assert account.role is Role.OPERATOR
    assert account.has_password(PASSWORD)
    assert not account.has_password(PASSWORD + " ")
    assert PASSWORD not in file.read_text()
    assert file.stat().st_mode & 0o777 == 0o600
    other = account_line("ann", Role.OPERATOR, PASSWORD)
    assert other != account.line, "each has a salt of its own"


def test_an_account_is_changed_and_removed_and_the_others_stay(file: Path) -> None:
    write_account(file, "bob", account_line("bob", Role.VIEWER, "long enough 1"))
    assert write_account(file, "ann", account_line("ann", Role.VIEWER, "long enough 2"))
    assert {name: one.role for name, one in read_accounts(file).items()} == {"ann": "viewer", "bob": "viewer"}
    assert write_account(file, "ann", None)
    assert not write_account(file, "ann", None)
    assert [*read_accounts(file)] == ["bob"]


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("ann", "line 2 is no account"),
        ("eve:admin:$scrypt$ln=15,r=8,p=1$AAAA$AAAA", "line 2 is no account"),
        ("eve:viewer:$scrypt$ln=30,r=8,p=1$AAAA$AAAA", "line 2 is no account"),
        ("eve:viewer:$scrypt$ln=15,r=8,p=1$AAA$AAAA", "line 2 is no account"),
    ],
)
def test_a_file_with_another_line_is_refused(file: Path, line: str, words: str) -> None:
    file.write_text(file.read_text() + line + "\n")
    with pytest.raises(AccountsError, match=words):
        read_accounts(file)


def test_a_file_that_others_may_read_is_refused(file: Path) -> None:
    file.chmod(0o640)
    with pytest.raises(AccountsError, match=r"may be read or written by others: chmod 600"):
        AccountsFile(file)


def test_a_file_without_accounts_is_refused(tmp_path: Path) -> None:
    with pytest.raises(AccountsError, match="make the first account with daqsvc account"):
        AccountsFile(tmp_path / "none")


async def test_a_session_ends_with_its_account_and_with_another_password(file: Path) -> None:
    by = ByAccounts(AccountsFile(file))
    secret = await by.sign_in("ann", PASSWORD, "192.0.2.1")
    person = by.person(asking(cookie=secret))
    assert person is not None
    assert (person.name, person.role) == ("ann", Role.OPERATOR)
    assert by.person(asking(cookie=secret + "x")) is None
    assert by.person(asking()) is None
    write_account(file, "ann", account_line("ann", Role.VIEWER, PASSWORD))
    assert by.person(asking(cookie=secret)) is None, "its role is another one by now"
    secret = await by.sign_in("ann", PASSWORD, "192.0.2.1")
    by.end(secret)
    assert by.person(asking(cookie=secret)) is None
    secret = await by.sign_in("ann", PASSWORD, "192.0.2.1")
    write_account(file, "ann", None)
    assert by.person(asking(cookie=secret)) is None, "it was removed"


async def test_a_name_that_is_not_there_is_refused_in_the_same_words(file: Path) -> None:
    by = ByAccounts(AccountsFile(file))
    for name, password in (("ann", "wrong"), ("nobody", PASSWORD), ("ann", "x" * 5000), ("", "")):
        with pytest.raises(SignInError, match=r"^name or password are wrong$"):
            await by.sign_in(name, password, f"peer of {name!r} {len(password)}")


async def test_who_tries_too_often_waits(file: Path) -> None:
    by = ByAccounts(AccountsFile(file))
    for _ in range(TRIES):
        with pytest.raises(SignInError, match="wrong"):
            await by.sign_in("ann", "wrong", "192.0.2.1")
    with pytest.raises(SignInError, match=r"too many tries: try again in \d+ s"):
        await by.sign_in("ann", PASSWORD, "192.0.2.2")


def test_sessions_end_by_themselves() -> None:
    now_s = [0.0]
    sessions = Sessions(lambda: now_s[0])
    idle, used = sessions.begin("a", ""), sessions.begin("b", "")
    now_s[0] = IDLE_S - 1
    assert sessions.of(used) is not None
    now_s[0] = IDLE_S + 1
    assert sessions.of(idle) is None
    while now_s[0] < LONGEST_S - IDLE_S:
        now_s[0] += IDLE_S / 2
        assert sessions.of(used) is not None
    now_s[0] = LONGEST_S + 1
    assert sessions.of(used) is None
    first = sessions.begin("first", "")
    for _ in range(MOST):
        sessions.begin("many", "")
    assert sessions.of(first) is None, "they take no memory without end"


def test_tries_come_back_with_time_and_take_no_memory_without_end() -> None:
    now_s = [0.0]
    tries = Tries(lambda: now_s[0])
    assert [tries.wait_s("a") for _ in range(TRIES)] == [0.0] * TRIES
    assert tries.wait_s("a") == TRY_EVERY_S
    assert tries.wait_s("a") == TRY_EVERY_S, "to ask costs nothing"
    assert tries.wait_s("b", "a") == TRY_EVERY_S
    now_s[0] += TRY_EVERY_S
    assert tries.wait_s("a") == 0.0
    assert tries.wait_s("a") == TRY_EVERY_S
    tries.forget("a")
    assert tries.wait_s("a") == 0.0
    for number in range(2 * MOST_TRIERS):
        tries.wait_s(f"{number}")
    assert len(tries._spent) == MOST_TRIERS


def test_a_proxy_is_believed_and_nobody_else() -> None:
    by = ByProxy("X-User", ["127.0.0.1", "::1"], ["ann"])
    ann = by.person(asking(headers=[("x-user", "ann")]))
    bob = by.person(asking("::1", headers=[("x-user", "bob")]))
    assert ann is not None
    assert bob is not None
    assert (ann.role, bob.role) == (Role.OPERATOR, Role.VIEWER)
    assert by.person(asking("192.0.2.9", headers=[("x-user", "ann")])) is None
    assert "through its reverse proxy only" in by.why_not(asking("192.0.2.9", headers=[("x-user", "ann")]))
    for headers in ([], [("x-user", "")], [("x-user", "ann"), ("x-user", "bob")], [("x-user", "an\tn")]):
        assert by.person(asking(headers=headers)) is None, headers


def test_the_operators_key_is_of_one_start() -> None:
    here = OpenHere("the key")
    assert here.person(asking()).role is Role.VIEWER
    with pytest.raises(SignInError):
        here.begin("another")
    with pytest.raises(SignInError):
        OpenHere().begin("")
    assert here.person(asking(cookie=here.begin("the key"))).role is Role.OPERATOR


@pytest.mark.parametrize(
    ("asked", "words"),
    [
        ({"host": "0.0.0.0"}, "give --host-name for each"),  # noqa: S104 - refused
        ({"host": "0.0.0.0", "names": ("box",)}, "others than this box reach the page"),  # noqa: S104
        ({"host": "192.0.2.7", "accounts": "a"}, "others than this box reach the page"),
        (
            {"host": "192.0.2.7", "certificate": "c", "private_key": "k"},
            "others than this box reach the page",
        ),
        ({"host": "127.0.0.1", "certificate": "c"}, "belong together"),
        ({"host": "127.0.0.1", "accounts": "a", "user_header": "X"}, "choose one"),
        ({"host": "192.0.2.7", "user_header": "X"}, "name them by --proxy"),
        ({"host": "127.0.0.1", "operators": ("ann",)}, "--user-header: give it"),
        ({"host": "127.0.0.1", "accounts": "a", "operator_link": True}, "leave it out"),
    ],
)
def test_what_is_unsafe_does_not_start(asked: dict[str, Any], words: str) -> None:
    with pytest.raises(UnsafeError, match=words):
        AccessChoice(**asked).refuse_unsafe()


@pytest.mark.parametrize(
    "asked",
    [
        {"host": "127.0.0.1"},
        {"host": "::1"},
        {"host": "localhost", "operator_link": True},
        {"host": "192.0.2.7", "certificate": "c", "private_key": "k", "accounts": "a"},
        {"host": "::", "certificate": "c", "private_key": "k", "accounts": "a", "names": ("box",)},
        {"host": "192.0.2.7", "user_header": "X", "proxies": ("192.0.2.8",)},
    ],
)
def test_what_is_safe_does(asked: dict[str, Any]) -> None:
    AccessChoice(**asked).refuse_unsafe()


def test_the_verb_makes_accounts(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    file = f"{tmp_path / 'accounts'}"
    monkeypatch.setattr("sys.stdin", io.StringIO("long enough\n"))
    assert main(["account", file, "ann", "--role", "operator"]) == 0
    assert capsys.readouterr().out == "ann may sign in as operator\n"
    assert read_accounts(tmp_path / "accounts")["ann"].has_password("long enough")
    monkeypatch.setattr("sys.stdin", io.StringIO("short\n"))
    assert main(["account", file, "bob"]) == 1
    assert "a password has 10 to 1024 characters" in capsys.readouterr().err
    with pytest.raises(SystemExit):
        main(["account", file, "a:b"])
    assert main(["account", file, "ann", "--remove"]) == 0
    assert main(["account", file, "ann", "--remove"]) == 1
    assert "has no account ann" in capsys.readouterr().err
