"""The only bus or stream of a machine file, whatever it is called."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Mapping


def only_stream(machine: Mapping[str, Any]) -> Any:
    """Its one table below ``[streams]``."""
    [stream] = machine["streams"].values()
    return stream


def only_bus(machine: Mapping[str, Any]) -> Any:
    """Its one table below ``[buses]``."""
    [bus] = machine["buses"].values()
    return bus


def names_in(machine: Mapping[str, Any]) -> set[tuple[str, str, str]]:
    """The bus and the stream of each sensor, and its name."""
    streams = machine["streams"]
    return {(streams[one["stream"]]["bus"], one["stream"], one["name"]) for one in machine["sensors"]}
