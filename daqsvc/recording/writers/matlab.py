"""MATLAB files of version 5 to 7: a struct for each stream, with a field for each channel."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Any

import numpy as np

from daqsvc.errors.recordings import NOT_HELD
from daqsvc.recording import RecordingError
from daqsvc.recording.contents import MEASURED_RATE, STATED_RATE, STATED_START

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence
    from pathlib import Path

    from daqsvc.recording.streams import RecordedStream

LONGEST = 63
"""Characters of a name in MATLAB."""
MOST_BYTES = 2**31 - 1
"""Of a variable."""
OTHERS = ("fields", "names", "units", "stream", STATED_RATE, STATED_START, MEASURED_RATE)
"""Fields of a stream's struct beside its channels."""


def write_mat(path: Path, streams: Sequence[RecordedStream], about: Mapping[str, str]) -> list[str]:
    """Write all streams; a missing sample is NaN.

    ``names`` has the names of the sensors, ``fields`` the fields of their samples, as a name in MATLAB has
    letters, digits and underscores only.

    Raises:
        RecordingError: a stream is larger than a variable may be.
    """
    from scipy.io import savemat  # noqa: PLC0415 - slow to import, and only this format needs it

    variables: dict[str, Any] = {}
    names = _identifiers((stream.name for stream in streams), ("about",))
    for variable, stream in zip(names, streams, strict=True):
        if stream.samples.nbytes > MOST_BYTES:
            raise RecordingError(
                f"stream {stream.name} has {stream.samples.nbytes / 1e9:.3g} GB of samples, and a variable "
                "of a MATLAB file of version 7 holds 2; write .parquet or .mf4",
                NOT_HELD,
            )
        fields = _identifiers(stream.names, OTHERS)
        variables[variable] = {
            "stream": stream.name,
            STATED_RATE: stream.rate_hz,
            STATED_START: stream.start,
            MEASURED_RATE: np.nan if stream.measured_hz is None else stream.measured_hz,
            "names": _cells(stream.names),
            "units": _cells(stream.units),
            "fields": _cells(fields),
            **dict(zip(fields, stream.samples.T, strict=True)),
        }
    if about:
        variables["about"] = dict(about)
    savemat(path, variables, long_field_names=True, oned_as="column")
    return []


def _cells(texts: Sequence[str]) -> Any:
    cells = np.empty(len(texts), object)
    cells[:] = texts
    return cells


def _identifiers(names: Iterable[str], taken: Iterable[str]) -> list[str]:
    """Names that MATLAB takes, each once."""
    used = set(taken)
    made = []
    for name in names:
        plain = re.sub(r"[^A-Za-z0-9_]", "_", name)
        plain = (plain if plain[:1].isalpha() else f"x{plain}")[: LONGEST - 4]
        one, number = plain, 1
        while one in used:
            number += 1
            one = f"{plain}_{number}"
        used.add(one)
        made.append(one)
    return made
