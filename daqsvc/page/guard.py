"""What stands before every page: who asks is known, and nothing is changed for another site.

A request that changes something is a form of this page: a browser states where it comes from (Fetch Metadata,
or the Origin header), and it has the token that its person's forms have.
"""

from __future__ import annotations

import hashlib
import hmac
import secrets
from typing import TYPE_CHECKING
from urllib.parse import parse_qsl, quote, urlsplit

from starlette.requests import Request
from starlette.responses import PlainTextResponse, RedirectResponse

if TYPE_CHECKING:
    from starlette.types import ASGIApp, Message, Receive, Scope, Send

    from daqsvc.page.access.person import Access, Person

_POLICY = (
    # BokehJS puts styles into its figures.
    "default-src 'none'; script-src 'self'; connect-src 'self'; img-src 'self' data: blob:; "
    "style-src 'self' 'unsafe-inline'; base-uri 'none'; form-action 'self'; frame-ancestors 'self'"
)
FRAMING = f"{_POLICY}; frame-src 'self'"
"""Of the page that shows two others beside each other."""
HEADERS = {
    "content-security-policy": _POLICY,
    "x-content-type-options": "nosniff",
    "referrer-policy": "same-origin",
    "cache-control": "no-store",
}
FREE = ("/sign-in", "/operator", "/static/page.css")
"""What is answered before it is known who asks."""
LONGEST_FORM = 8 * 1024
MOST_FIELDS = 20


class FormError(Exception):
    """What was sent is no form of this page; the text states why."""


class Guarded:
    """Adds `HEADERS` to whatever is answered.

    Args:
        app: what answers.
    """

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """See the ASGI specification."""

        async def guarded(message: Message) -> None:
            if message["type"] == "http.response.start":
                own = {name.lower() for name, _ in message["headers"]}
                added = [(name.encode(), value.encode()) for name, value in HEADERS.items()]
                message["headers"] = [*message["headers"], *(one for one in added if one[0] not in own)]
            await send(message)

        await self._app(scope, receive, guarded)


class Admitted:
    """Refuses whoever is not known; puts who it is into ``request.state.person``.

    Args:
        app: what answers.
        access: knows who asks.
    """

    def __init__(self, app: ASGIApp, access: Access) -> None:
        self._app = app
        self._access = access

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """See the ASGI specification."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        request = Request(scope, receive)
        person = self._access.person(request)
        request.state.person = person
        if person is not None or scope["path"] in FREE:
            await self._app(scope, receive, send)
            return
        is_page = request.method == "GET" and "text/html" in request.headers.get("accept", "")
        if self._access.signs_in and is_page:
            there = quote(scope["path"] + (f"?{request.url.query}" if request.url.query else ""))
            await RedirectResponse(f"/sign-in?then={there}", 303)(scope, receive, send)
            return
        status = 401 if self._access.signs_in else 403
        await PlainTextResponse(self._access.why_not(request), status)(scope, receive, send)


class Forms:
    """Reads the forms of the page, and makes the tokens by which they are known."""

    def __init__(self) -> None:
        self._key = secrets.token_bytes(32)

    def token(self, person: Person | None) -> str:
        """What each form of a person has with it."""
        of_whom = "" if person is None else person.session
        return hmac.new(self._key, of_whom.encode("utf-8", "surrogatepass"), hashlib.sha256).hexdigest()

    async def read(self, request: Request) -> dict[str, str]:
        """The fields of a form.

        Raises:
            FormError: it is none of this page.
        """
        if not _is_of_this_page(request):
            raise FormError("it comes from another site")
        if request.headers.get("content-type", "").partition(";")[0] != "application/x-www-form-urlencoded":
            raise FormError("it is no form")
        body = b""
        async for piece in request.stream():
            body += piece
            if len(body) > LONGEST_FORM:
                raise FormError(f"it is longer than {LONGEST_FORM} bytes")
        try:
            pairs = parse_qsl(
                body.decode("utf-8"), keep_blank_values=True, max_num_fields=MOST_FIELDS, errors="strict"
            )
        except ValueError:
            raise FormError("it is no form") from None
        fields = dict(pairs)
        if len(fields) < len(pairs):
            raise FormError("a field is in it twice")
        token = fields.pop("token", "").encode("utf-8", "replace")
        if not hmac.compare_digest(token, self.token(request.state.person).encode()):
            raise FormError("it is of another session: open the page again, and send it from there")
        return fields


def _is_of_this_page(request: Request) -> bool:
    """Whether a browser states that a form comes from a page of this server."""
    site = request.headers.get("sec-fetch-site")
    if site is not None and site != "same-origin":
        return False
    origin = request.headers.get("origin")
    if origin is None:
        return site is not None
    host = request.headers.get("host", "")
    return bool(host) and urlsplit(origin).netloc.lower() == host.lower()
