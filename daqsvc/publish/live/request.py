"""What is asked for: to be told what passes of a machine, for so long."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from daqsvc.alarms.commands import JsonCommand, Line

LONGEST_LEASE_S = 60.0
MOST_BYTES = 32 * 1024
"""Of a request."""


class LiveRequestPayload(JsonCommand):
    """A wish to look on; of which machine, and who looks, stands in the topic."""

    schema_: Literal["daqsvc.live-request/1"] = Field(alias="schema")
    feed: Annotated[int, Field(ge=0, lt=10**15)] = Field(
        description="number of the feed, chosen by who looks: another one begins anew"
    )
    streams: Annotated[
        tuple[Annotated[Line, Field(min_length=1, max_length=200)], ...], Field(strict=False, max_length=256)
    ] = Field(default=(), description="streams and grids whose samples are wanted; none for no samples")
    lease_s: Annotated[float, Field(ge=0, le=LONGEST_LEASE_S)] = Field(
        description="for how long from now on; ask again before it is over, 0 ends it"
    )
