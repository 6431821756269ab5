"""Who asks, and how a page comes to know it."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple, Protocol

if TYPE_CHECKING:
    from starlette.requests import HTTPConnection

    from daqsvc.page.access.role import Role


class Person(NamedTuple):
    """Who asks.

    Attributes:
        name: under which it is in the audit log.
        role: what this person may do.
        session: what the tokens of this person's forms are bound to.
        can_sign_out: whether the page has signed this person in.
    """

    name: str
    role: Role
    session: str
    can_sign_out: bool = False


class Access(Protocol):
    """One way in which the page knows who asks.

    Attributes:
        signs_in: whether it has a form to sign in by.
    """

    signs_in: bool

    def person(self, request: HTTPConnection) -> Person | None:
        """Who asks; None if that is not known."""
        ...

    def why_not(self, request: HTTPConnection) -> str:
        """Why it is not known who asks, and the remedy."""
        ...


def peer_of(request: HTTPConnection) -> str:
    """The address of who is connected, as far as it is known."""
    return "" if request.client is None else request.client.host
