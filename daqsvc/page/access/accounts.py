"""Accounts of the page: a file of names, roles and passwords, of which only hashes are kept.

Each line is ``NAME:ROLE:$scrypt$ln=15,r=8,p=1$SALT$HASH``, salt and hash in base64 (the modular crypt format,
with scrypt of RFC 7914). `daqsvc account` writes it. The file is read again when it has changed.
"""

from __future__ import annotations

import base64
import hashlib
import hmac
import logging
import os
import re
import secrets
import stat
import tempfile
from typing import TYPE_CHECKING, NamedTuple

from daqsvc.errors.code import coded
from daqsvc.errors.command_line import ACCOUNTS
from daqsvc.page.access.role import Role

if TYPE_CHECKING:
    from pathlib import Path

log = logging.getLogger(__name__)

MODE = 0o600
MOST_BYTES = 1_000_000
LOG2_N, R, P = 15, 8, 1
"""Cost of scrypt: 32 MiB and about a tenth of a second."""
MOST_LOG2_N, MOST_R, MOST_P = 18, 16, 4
SALT_BYTES = 16
LONGEST_PASSWORD = 1024
NAME = re.compile(r"[A-Za-z0-9._@-]{1,64}")
NAME_IN_WORDS = "letters, digits and . _ @ -, 64 characters at most"
_LINE = re.compile(
    r"(?P<name>[^:]*):(?P<role>[^:]*):\$scrypt\$ln=(?P<n>\d{1,2}),r=(?P<r>\d{1,2}),p=(?P<p>\d)"
    r"\$(?P<salt>[A-Za-z0-9+/=]+)\$(?P<hash>[A-Za-z0-9+/=]+)"
)


class AccountsError(Exception):
    """The file of the accounts cannot be used; the text names it, what is wrong and the remedy."""

    code = ACCOUNTS


class Account(NamedTuple):
    """One account.

    Attributes:
        name: its name.
        role: what it may do.
        line: as it is in the file; a different one if any part of it differs.
    """

    name: str
    role: Role
    line: str

    def has_password(self, password: str) -> bool:
        """Whether that is its password; takes a tenth of a second."""
        match = _LINE.fullmatch(self.line)
        assert match is not None  # noqa: S101 - it was read so
        cost = int(match["n"]), int(match["r"]), int(match["p"])
        made = _hashed(password, base64.b64decode(match["salt"]), *cost)
        return hmac.compare_digest(made, base64.b64decode(match["hash"]))


class AccountsFile:
    """The accounts in a file, as they are there at any moment.

    Args:
        path: the file.

    Raises:
        AccountsError: it cannot be used.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._stamp: tuple[int, ...] = ()
        self._accounts: dict[str, Account] = {}
        self._why = ""
        self._read()
        if not self._accounts:
            raise AccountsError(f"{path} holds no account: make one with daqsvc account {path} NAME")

    def named(self, name: str) -> Account | None:
        """The account of that name; None if there is none by now, or the file cannot be used any more."""
        try:
            self._read()
        except AccountsError as error:
            self._accounts = {}
            self._stamp = ()
            if self._why != f"{error}":
                self._why = f"{error}"
                log.error("nobody can sign in until this is corrected: %s", error, extra=coded(error.code))  # noqa: TRY400
        return self._accounts.get(name)

    def _read(self) -> None:
        """Read the file again if it has changed; cheap if not."""
        try:
            status = self.path.stat()
        except OSError as error:
            raise AccountsError(_unreadable(self.path, error)) from None
        stamp = (status.st_mtime_ns, status.st_ino, status.st_size, status.st_mode, status.st_uid)
        if stamp != self._stamp:
            self._accounts = read_accounts(self.path)
            self._stamp, self._why = stamp, ""


def read_accounts(path: Path) -> dict[str, Account]:
    """The accounts in a file, by their names.

    Raises:
        AccountsError: it cannot be read, others may read it, or a line of it is no account.
    """
    try:
        with path.open("rb") as file:
            status = os.fstat(file.fileno())
            data = file.read(MOST_BYTES + 1)
    except OSError as error:
        raise AccountsError(_unreadable(path, error)) from None
    if stat.S_IMODE(status.st_mode) & 0o077:
        raise AccountsError(f"{path} may be read or written by others: chmod 600 {path}")
    if len(data) > MOST_BYTES:
        raise AccountsError(f"{path} is larger than {MOST_BYTES} bytes: it is no file of accounts")
    accounts: dict[str, Account] = {}
    for number, line in enumerate(data.decode("utf-8", "replace").splitlines(), 1):
        if not line.strip() or line.startswith("#"):
            continue
        account = _account(line.strip())
        if account is None or account.name in accounts:
            what = "is no account" if account is None else f"names {account.name} again"
            raise AccountsError(
                f"{path}, line {number} {what}: remove the line, and make the account with "
                f"daqsvc account {path} NAME"
            )
        accounts[account.name] = account
    return accounts


def _account(line: str) -> Account | None:
    match = _LINE.fullmatch(line)
    if match is None or NAME.fullmatch(match["name"]) is None or match["role"] not in {*Role}:
        return None
    n, r, p = (int(match[one]) for one in "nrp")
    if not (0 < n <= MOST_LOG2_N and 0 < r <= MOST_R and 0 < p <= MOST_P):
        return None
    try:
        base64.b64decode(match["salt"], validate=True)
        base64.b64decode(match["hash"], validate=True)
    except ValueError:
        return None
    return Account(match["name"], Role(match["role"]), line)


def account_line(name: str, role: Role, password: str) -> str:
    """An account as a line of the file."""
    salt = secrets.token_bytes(SALT_BYTES)
    made = _hashed(password, salt, LOG2_N, R, P)
    encoded = (base64.b64encode(one).decode() for one in (salt, made))
    return f"{name}:{role}:$scrypt$ln={LOG2_N},r={R},p={P}${'$'.join(encoded)}"


def write_account(path: Path, name: str, line: str | None) -> bool:
    """Put an account into a file in place of what it has of that name, or take it out; blocks.

    Args:
        path: the file; it is made if it is not there.
        name: of the account.
        line: from `account_line`; None to take it out.

    Returns:
        Whether there was an account of that name.

    Raises:
        AccountsError: the file cannot be used, or written.
    """
    accounts = {} if line is not None and not path.exists() else read_accounts(path)
    was_there = accounts.pop(name, None) is not None
    lines = [one.line for one in accounts.values()] + ([] if line is None else [line])
    try:
        descriptor, made = tempfile.mkstemp(prefix=".", dir=path.parent)
        try:
            with os.fdopen(descriptor, "w") as file:
                os.fchmod(file.fileno(), MODE)
                if path.exists():
                    owner = path.stat()
                    os.fchown(file.fileno(), owner.st_uid, owner.st_gid)
                file.writelines(f"{one}\n" for one in lines)
                file.flush()
                os.fsync(file.fileno())
            os.replace(made, path)  # noqa: PTH105 - a name of a temporary file
        except BaseException:
            os.unlink(made)  # noqa: PTH108 - as above
            raise
    except OSError as error:
        raise AccountsError(f"{path} cannot be written: {error.strerror or error}") from None
    return was_there


def pretend_to_look(password: str) -> None:
    """Take as long as for an account that is there: nobody learns from the time which names there are."""
    _hashed(password, b"\0" * SALT_BYTES, LOG2_N, R, P)


def _hashed(password: str, salt: bytes, log2_n: int, r: int, p: int) -> bytes:
    needed = 128 * (1 << log2_n) * r
    return hashlib.scrypt(
        password.encode("utf-8", "surrogatepass"), salt=salt, n=1 << log2_n, r=r, p=p, maxmem=2 * needed
    )


def _unreadable(path: Path, error: OSError) -> str:
    if isinstance(error, FileNotFoundError):
        return f"{path} does not exist: make the first account with daqsvc account {path} NAME"
    return f"{path} cannot be read: {error.strerror or error}; it belongs to who runs the page"
