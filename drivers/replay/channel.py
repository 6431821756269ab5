"""One channel of a CAN log that may hold several: a bus is one channel, and ids mean nothing on another."""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Sequence

    import can

logger = logging.getLogger(__name__)

REMEMBERED_CHANNELS = 16


class ChannelChoice:
    """Takes the frames of one channel, the first one that comes unless another is wanted.

    Args:
        link_name: what a person calls the bus.
        wanted: the channel, as the log calls it; None for the first one.
    """

    def __init__(self, link_name: str, wanted: str | None) -> None:
        self._link_name = link_name
        self._wanted = wanted
        self._chosen = wanted
        self._found = False
        self._others: list[str] = []

    @property
    def missed(self) -> str:
        """What to tell a person of a log that has no frame of the wanted channel; empty if it has some."""
        if self._wanted is None or self._found or not self._others:
            return ""
        return (
            f"it has no frame of channel {self._wanted!r}; write another of its channels as channel: "
            f"{', '.join(self._others)}"
        )

    def of(self, messages: Sequence[can.Message]) -> list[int]:
        """Which of the messages to take: those of the chosen channel, and those whose channel is not named.

        Other channels are said once each.
        """
        names = [None if message.channel is None else str(message.channel) for message in messages]
        named = dict.fromkeys(name for name in names if name is not None)
        if self._chosen is None:
            self._chosen = next(iter(named), None)
        self._found = self._found or self._chosen in named
        for name in named:
            if name != self._chosen and name not in self._others:
                self._tell_of(name)
        return [k for k, name in enumerate(names) if name is None or name == self._chosen]

    def _tell_of(self, name: str) -> None:
        if len(self._others) >= REMEMBERED_CHANNELS:
            return
        self._others.append(name)
        logger.warning(
            "%s: the log has frames of channel %s too, and only those of %s are played; others are counted "
            "(frames_other_channel). Write channel = %r to play these, on a bus of their own if both are",
            self._link_name,
            name,
            self._chosen,
            name,
        )
