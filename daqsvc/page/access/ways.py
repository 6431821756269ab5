"""The ways in which the page knows who asks: anybody on the box, accounts, or a reverse proxy."""

from __future__ import annotations

import asyncio
import getpass
import hmac
import ipaddress
import math
import secrets
from typing import TYPE_CHECKING

from daqsvc.page.access.accounts import LONGEST_PASSWORD, pretend_to_look
from daqsvc.page.access.person import Person, peer_of
from daqsvc.page.access.role import Role
from daqsvc.page.access.sessions import Sessions, Tries

if TYPE_CHECKING:
    from collections.abc import Collection

    from starlette.requests import HTTPConnection

    from daqsvc.page.access.accounts import AccountsFile

COOKIE = "daqsvc_page"
"""Browsers know no port: two pages of one host end each other's sessions."""
MOST_AT_ONCE = 2
"""Passwords that are read at a time: each takes memory and a tenth of a second."""


class SignInError(Exception):
    """Nobody was signed in; the text states why, as far as a stranger may know it."""


class OpenHere:
    """Anybody on this box may look; who has the operator's key, which is made again at each start, may act.

    Args:
        key: lets whoever has it act; empty if nobody may act.
    """

    signs_in = False

    def __init__(self, key: str = "") -> None:
        self._key = key
        self._sessions = Sessions()
        self._name = _user()

    def person(self, request: HTTPConnection) -> Person:
        """See `daqsvc.page.access.person.Access.person`."""
        secret = request.cookies.get(COOKIE, "")
        if secret and self._sessions.of(secret) is not None:
            return Person(self._name, Role.OPERATOR, secret, can_sign_out=True)
        return Person("anybody on this box", Role.VIEWER, "")

    def why_not(self, request: HTTPConnection) -> str:
        """See `daqsvc.page.access.person.Access.why_not`."""
        del request
        return "the page does not know who asks"

    def begin(self, key: str) -> str:
        """Let who has the key act; the secret for the browser.

        Raises:
            SignInError: it is another key.
        """
        if not self._key or not hmac.compare_digest(key.encode("utf-8", "replace"), self._key.encode()):
            raise SignInError(
                "that is no key of this page: open the address that daqsvc page --operator-link has "
                "printed at its last start"
            )
        return self._sessions.begin(self._name, "")

    def end(self, secret: str) -> None:
        """Sign out."""
        self._sessions.end(secret)


class ByAccounts:
    """Who has signed in with an account.

    Args:
        accounts: the accounts.
    """

    signs_in = True

    def __init__(self, accounts: AccountsFile) -> None:
        self._accounts = accounts
        self._sessions = Sessions()
        self._tries = Tries()
        self._looking = asyncio.Semaphore(MOST_AT_ONCE)

    def person(self, request: HTTPConnection) -> Person | None:
        """See `daqsvc.page.access.person.Access.person`."""
        secret = request.cookies.get(COOKIE, "")
        session = self._sessions.of(secret) if secret else None
        if session is None:
            return None
        account = self._accounts.named(session.name)
        if account is None or account.line != session.line:
            # It was removed, or has another password or role by now.
            self._sessions.end(secret)
            return None
        return Person(account.name, account.role, secret, can_sign_out=True)

    def why_not(self, request: HTTPConnection) -> str:
        """See `daqsvc.page.access.person.Access.why_not`."""
        del request
        return "sign in first"

    async def sign_in(self, name: str, password: str, peer: str) -> str:
        """Sign somebody in; the secret for the browser.

        Raises:
            SignInError: name or password are wrong, or it was tried too often.
        """
        wait_s = self._tries.wait_s(f"name {name[:64]}", f"peer {peer}")
        if wait_s > 0:
            raise SignInError(f"too many tries: try again in {math.ceil(wait_s)} s")
        account = self._accounts.named(name)
        async with self._looking:
            if account is None or len(password) > LONGEST_PASSWORD:
                await asyncio.to_thread(pretend_to_look, password[:LONGEST_PASSWORD])
                is_right = False
            else:
                is_right = await asyncio.to_thread(account.has_password, password)
        if account is None or not is_right:
            raise SignInError("name or password are wrong")
        self._tries.forget(f"name {name[:64]}", f"peer {peer}")
        return self._sessions.begin(account.name, account.line)

    def end(self, secret: str) -> None:
        """Sign out."""
        self._sessions.end(secret)


class ByProxy:
    """Whom a reverse proxy has signed in, and names in a header.

    Args:
        header: its name.
        proxies: addresses of the proxies, which alone are believed.
        operators: users that may handle alarms; all others may look.
    """

    signs_in = False

    def __init__(self, header: str, proxies: Collection[str], operators: Collection[str]) -> None:
        self._header = header.lower()
        self._proxies = frozenset(ipaddress.ip_address(one) for one in proxies)
        self._operators = frozenset(operators)

    def person(self, request: HTTPConnection) -> Person | None:
        """See `daqsvc.page.access.person.Access.person`."""
        if self.why_not(request):
            return None
        name = request.headers[self._header].strip()
        role = Role.OPERATOR if name in self._operators else Role.VIEWER
        return Person(name, role, f"proxy {name}")

    def why_not(self, request: HTTPConnection) -> str:
        """See `daqsvc.page.access.person.Access.why_not`."""
        try:
            is_known = ipaddress.ip_address(peer_of(request)) in self._proxies
        except ValueError:
            is_known = False
        if not is_known:
            return "this page is opened through its reverse proxy only"
        names = request.headers.getlist(self._header)
        if len(names) != 1 or not names[0].strip() or not names[0].isprintable() or len(names[0]) > 100:
            return f"the reverse proxy does not name in one header {self._header} who asks"
        return ""


def new_key() -> str:
    """A key for `OpenHere`."""
    return secrets.token_urlsafe(24)


def _user() -> str:
    try:
        return getpass.getuser()
    except (OSError, KeyError):
        return "operator"
