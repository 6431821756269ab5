"""Frame layouts from DBC files."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from drivers.frames import ByteOrder, Counts, Field, FrameLayout, Kind, LayoutError, Selector

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence
    from pathlib import Path

    from cantools.database.can.signal import Signal


def layout_from_dbc(
    path: Path,
    message: str,
    *,
    counter: str | None,
    counts: Counts,
    channels: Mapping[str, Sequence[str]],
    valid_raw: Mapping[str, tuple[float, float]] | None = None,
) -> FrameLayout:
    """The layout of one message of a DBC file.

    Multiplexed signals are those of some pages of the message: the layout then has only the frames with all
    of its signals, and the counter must count these alone.

    Args:
        path: the DBC file.
        message: name of the message.
        counter: name of the counter signal; None if there is none.
        counts: what it counts.
        channels: for each channel the signals of its consecutive samples.
        valid_raw: see `FrameLayout`.

    Raises:
        LayoutError: the file, the message or a signal is not there, no frame has all of the signals, or
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
        kind: Kind = "float" if signal.is_float else "signed" if signal.is_signed else "unsigned"
        order: ByteOrder = "little" if signal.byte_order == "little_endian" else "big"
        return Field(signal.start, signal.length, kind, order)

    names = [] if counter is None else [counter]
    names += [name for column in channels.values() for name in column]
    cells = {name: field(name) for name in names}
    pages = selecting_values(signals, names)
    if not all(pages.values()):
        raise LayoutError(
            f"no frame of message {message!r} of {path} holds all of {names}: they are on different pages of "
            "its multiplexer; make a stream for each page"
        )
    rows = list(zip(*channels.values(), strict=True))
    return FrameLayout(
        frame_id=described.frame_id,
        extended=described.is_extended_frame,
        length=described.length,
        channels=tuple(channels),
        fields=tuple(tuple(cells[name] for name in row) for row in rows),
        scale=np.array([[float(signals[name].scale) for name in row] for row in rows]),
        offset=np.array([[float(signals[name].offset) for name in row] for row in rows]),
        counter=None if counter is None else cells[counter],
        counts=counts,
        any_priority=described.protocol == "j1939",
        valid_raw=valid_raw or {},
        selectors=tuple(Selector(name, field(name), values) for name, values in pages.items()),
    )


def selecting_values(signals: Mapping[str, Signal], names: Iterable[str]) -> dict[str, frozenset[int]]:
    """Which values of which multiplexers the frames have that hold all of some signals.

    Args:
        signals: all signals of a message, by name.
        names: of the signals that are wanted.

    Returns:
        Raw values by multiplexer, as deep as they are nested; no values where no frame holds them all.
    """
    wanted: dict[str, frozenset[int]] = {}
    for name in names:
        signal = signals[name]
        while signal.multiplexer_signal is not None and signal.multiplexer_ids is not None:
            ids = frozenset(signal.multiplexer_ids)
            wanted[signal.multiplexer_signal] = wanted.get(signal.multiplexer_signal, ids) & ids
            signal = signals[signal.multiplexer_signal]
    return wanted
