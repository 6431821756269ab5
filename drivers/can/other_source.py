"""Frames that a DBC file describes, but for the address of the device: the last byte of a SAE J1939 id."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping

_GROUP = 0x03FF_FF00
"""Bits of a 29-bit id that state what is in a frame (SAE J1939-21, 5.2): not the priority, not the source."""
_EXTENDED_IN_DBC = 0x8000_0000
"""How a DBC file marks an id of 29 bits."""


def other_sources(strangers: Iterable[int], messages: Mapping[str, int]) -> Iterator[str]:
    """Sentences on frames that are as a message describes them, but come from another address.

    Args:
        strangers: 29-bit ids that were heard and that no message has.
        messages: 29-bit ids of the messages that were not heard, by name.
    """
    for heard in strangers:
        for name, described in messages.items():
            if heard & _GROUP == described & _GROUP:
                yield (
                    f"0x{heard:08X} is {name} from the source address 0x{heard & 0xFF:02X}; in the DBC file "
                    f"it has 0x{described & 0xFF:02X} (SAE J1939). Remedy: in a copy of the DBC file write "
                    f"BO_ {heard | _EXTENDED_IN_DBC} in place of BO_ {described | _EXTENDED_IN_DBC}"
                )
                break
