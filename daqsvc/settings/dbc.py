"""Facts of a message in a DBC file, and whether a layout that names it can be read from it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Mapping


@dataclass(frozen=True, slots=True)
class DbcMessage:
    """What a machine file needs to know of a message in a DBC file.

    Attributes:
        frame_id: CAN id.
        extended: whether the id has 29 bits.
        fd: whether the DBC says that it is a CAN FD frame.
        length: payload bytes.
        signal_bits: width of each signal in bits, by name.
        signal_units: unit of each signal, by name; empty if the DBC gives none.
    """

    frame_id: int
    extended: bool
    fd: bool
    length: int
    signal_bits: Mapping[str, int]
    signal_units: Mapping[str, str]
