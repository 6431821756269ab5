"""Universal files: a binary data set 58 for each channel, as modal and acoustic software reads them."""

from __future__ import annotations

import warnings
from datetime import UTC, datetime
from typing import TYPE_CHECKING

import numpy as np

from daqsvc.recording.contents import STATED_RATE, STATED_START
from daqsvc.recording.writers.gaps import filled, notes_on_gaps

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from daqsvc.recording.streams import RecordedStream

TIME_RESPONSE, EVEN, TIME, UNKNOWN = 1, 1, 17, 0
QUANTITIES = {"m/s2": 12, "g": 12, "mm/s": 11, "m/s": 11, "um": 8, "mm": 8, "m": 8, "mil": 8}
"""Data types of ordinates by unit: acceleration, velocity, displacement; others are unknown."""
LONGEST, LONGEST_LABEL = 80, 20
"""Characters of a header line and of a label."""


def write_uff(path: Path, streams: Sequence[RecordedStream], about: Mapping[str, str]) -> list[str]:
    """Write all channels, in float64; a missing sample is 0, as pyuff writes no NaN.

    The first header line is the sensor, the second stream and machine, the third the begin to a second; the
    fourth has it to a nanosecond and the rate, which the abscissa has to six digits only.
    """
    import pyuff  # noqa: PLC0415 - an extra, and only this format needs it

    file = pyuff.UFF(str(path))
    numbered = [(stream, column) for stream in streams for column in range(len(stream.names))]
    for node, (stream, column) in enumerate(numbered, 1):
        unit = stream.units[column]
        started = f"{STATED_START} = {stream.start}, " if stream.start else ""
        data_set = pyuff.prepare_58(
            binary=1,
            func_type=TIME_RESPONSE,
            id1=_line(stream.names[column]),
            id2=_line(f"stream {stream.name}" + (f" of {about['machine']}" if "machine" in about else "")),
            id3=_date(stream.start_ns),
            id4=_line(f"{started}{STATED_RATE} = {stream.rate_hz!r}"),
            rsp_node=node,
            rsp_dir=0,
            ref_node=0,
            ref_dir=0,
            abscissa_spacing=EVEN,
            abscissa_spec_data_type=TIME,
            abscissa_axis_units_lab="s",
            ordinate_spec_data_type=QUANTITIES.get(unit, UNKNOWN),
            ordinate_axis_units_lab=_line(unit, LONGEST_LABEL) or "NONE",
            orddenom_spec_data_type=UNKNOWN,
            # Only the first two are looked at, of steps that are even.
            x=np.array([0.0, 1.0 / stream.rate_hz]),
            data=filled(stream.samples[:, column], np.float64),
        )
        data_set["ordinate_axis_lab"] = _line(stream.names[column], LONGEST_LABEL)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ResourceWarning)  # of binary files pyuff leaves one open
            try:
                file.write_sets(data_set, "add")
            except Exception as error:
                # pyuff says of whatever goes wrong that it went wrong.
                if isinstance(error.__context__, OSError):
                    raise error.__context__ from None
                raise
    return notes_on_gaps(path, streams, "UFF")


def _line(text: str, longest: int = LONGEST) -> str:
    """Text as the format takes it, which is ASCII."""
    return " ".join(text.split()).encode("ascii", "replace").decode()[:longest]


def _date(start_ns: int | None) -> str:
    if start_ns is None:
        return "NONE"
    return f"{datetime.fromtimestamp(start_ns // 1_000_000_000, UTC):%d-%b-%y %H:%M:%S}"
