"""Frame layouts from DBC files."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from drivers.frames import ByteOrder, Counts, Field, FrameLayout, Kind, LayoutError

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path


def layout_from_dbc(
    path: Path,
    message: str,
    *,
    counter: str,
    counts: Counts,
    channels: Mapping[str, Sequence[str]],
) -> FrameLayout:
    """The layout of one message of a DBC file.

    Args:
        path: the DBC file.
        message: name of the message.
        counter: name of the counter signal.
        counts: what it counts.
        channels: for each channel the signals of its consecutive samples.

    Raises:
        LayoutError: the file, the message or a signal is not there, a signal is multiplexed, or
            cantools is not installed.
    """
    try:
        # An extra, and slow to import.
        from cantools.database import can, load_file  # noqa: PLC0415
        from cantools.database.errors import Error  # noqa: PLC0415
    except ImportError as error:
        raise LayoutError(
            f"reading {path} needs cantools; install it with: pip install 'daqsvc[dbc]'"
        ) from error
    try:
        database = load_file(path)
        if not isinstance(database, can.Database):
            raise LayoutError(f"{path} describes no CAN messages; give a DBC file")
        described = database.get_message_by_name(message)
    except (OSError, KeyError, UnicodeError, Error) as error:
        raise LayoutError(f"message {message!r} of {path} cannot be read: {error}") from error
    signals = {signal.name: signal for signal in described.signals}

    def field(name: str) -> Field:
        if name not in signals:
            raise LayoutError(f"message {message!r} of {path} has no signal {name!r}; it has {list(signals)}")
        signal = signals[name]
        if signal.multiplexer_ids is not None:
            raise LayoutError(f"signal {name!r} of {path} is multiplexed; use a message without multiplexing")
        kind: Kind = "float" if signal.is_float else "signed" if signal.is_signed else "unsigned"
        order: ByteOrder = "little" if signal.byte_order == "little_endian" else "big"
        return Field(signal.start, signal.length, kind, order)

    rows = list(zip(*channels.values(), strict=True))
    return FrameLayout(
        frame_id=described.frame_id,
        extended=described.is_extended_frame,
        length=described.length,
        channels=tuple(channels),
        fields=tuple(tuple(field(name) for name in row) for row in rows),
        scale=np.array([[float(signals[name].scale) for name in row] for row in rows]),
        offset=np.array([[float(signals[name].offset) for name in row] for row in rows]),
        counter=field(counter),
        counts=counts,
    )
