"""A browser without a window, for the page's forms, and what the audit log has."""

from __future__ import annotations

import asyncio
import contextlib
import http.client
import json
import re
from typing import TYPE_CHECKING, Any, NamedTuple
from urllib.parse import urlencode, urlsplit

from support.waiting import PATIENCE_S

if TYPE_CHECKING:
    import ssl
    from pathlib import Path

PASSWORD = "correct horse"  # noqa: S105 - of a test


class Answer(NamedTuple):
    """What the page's server has answered."""

    status: int
    text: str
    headers: http.client.HTTPMessage


class Client:
    """A browser without a window, which keeps one cookie."""

    def __init__(self, address: str, trusted: ssl.SSLContext | None = None) -> None:
        self.address = address
        self.cookie = ""
        self._trusted = trusted

    async def get(self, path: str, **headers: str) -> Answer:
        return await asyncio.to_thread(self._ask, "GET", path, None, headers)

    async def post(self, path: str, fields: dict[str, str], **headers: str) -> Answer:
        return await self.send(path, urlencode(fields).encode(), **headers)

    async def send(self, path: str, body: bytes, **headers: str) -> Answer:
        told = {"origin": self.address, "content-type": "application/x-www-form-urlencoded"} | headers
        return await asyncio.to_thread(self._ask, "POST", path, body, told)

    async def token(self, path: str) -> str:
        found = re.search(r'name="token" value="(\w+)"', (await self.get(path)).text)
        assert found is not None
        return found[1]

    async def sign_in(
        self, name: str, password: str = PASSWORD, then: str = "/machines/laval-rig/alarms"
    ) -> Answer:
        fields = {"token": await self.token("/sign-in"), "name": name, "password": password, "then": then}
        return await self.post("/sign-in", fields)

    def _ask(self, method: str, path: str, body: bytes | None, headers: dict[str, str]) -> Answer:
        there = urlsplit(self.address)
        if self._trusted is None:
            connection = http.client.HTTPConnection(there.netloc, timeout=PATIENCE_S)
        else:
            connection = http.client.HTTPSConnection(there.netloc, timeout=PATIENCE_S, context=self._trusted)
        try:
            own = {"cookie": self.cookie} if self.cookie else {}
            connection.request(method, path, body, {"accept": "text/html"} | own | headers)
            answer = connection.getresponse()
            if (cookie := answer.headers.get("set-cookie")) is not None:
                self.cookie = cookie.partition(";")[0]
            return Answer(answer.status, answer.read().decode(errors="replace"), answer.headers)
        finally:
            connection.close()


def audited(store: Path) -> list[dict[str, Any]]:
    """The lines of the audit log."""
    with contextlib.suppress(FileNotFoundError):
        return [json.loads(line) for line in (store / "audit.jsonl").read_text().splitlines()]
    return []
