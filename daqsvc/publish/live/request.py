"""The request for live data of a machine, with its lease."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from daqsvc.alarms.commands import JsonCommand, Line
from daqsvc.publish.payloads import SCHEMA_ABOUT

LONGEST_LEASE_S = 60.0
MOST_BYTES = 32 * 1024
"""Of a request."""


class LiveRequestPayload(JsonCommand):
    """A request for live data; the topic names the machine and the viewer."""

    schema_: Literal["daqsvc.live-request/1"] = Field(alias="schema", description=SCHEMA_ABOUT)
    feed: Annotated[int, Field(ge=0, lt=10**15)] = Field(
        description="number of the feed, chosen by the viewer: another number starts a new feed"
    )
    streams: Annotated[
        tuple[Annotated[Line, Field(min_length=1, max_length=200)], ...], Field(strict=False, max_length=256)
    ] = Field(default=(), description="streams and grids whose samples are wanted; none for no samples")
    lease_s: Annotated[float, Field(ge=0, le=LONGEST_LEASE_S)] = Field(
        description="how long the feed is sent from now on; ask again before that, 0 ends it"
    )
