"""Universal files: a binary data set 58 for each channel, as modal and acoustic software reads them."""

from __future__ import annotations

import unicodedata
import warnings
from datetime import UTC, datetime
from typing import TYPE_CHECKING

import numpy as np

from daqsvc.recording.contents import STATED_RATE, STATED_START
from daqsvc.recording.streams import unique
from daqsvc.recording.writers.gaps import filled, notes_on_gaps

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from daqsvc.recording.streams import RecordedStream

TIME_RESPONSE, EVEN, TIME, UNKNOWN = 1, 1, 17, 0
QUANTITIES = {
    **dict.fromkeys(("m/s2", "g", "mg", "mm/s2"), 12),
    **dict.fromkeys(("mm/s", "m/s"), 11),
    **dict.fromkeys(("um", "mm", "m", "mil"), 8),
}
"""Data types of ordinates by unit: acceleration, velocity, displacement; others are unknown."""
LONGEST, LONGEST_LABEL = 80, 20
"""Characters of a header line and of a label."""
SPELLED = str.maketrans(
    {
        "\N{MICRO SIGN}": "u",
        "\N{GREEK SMALL LETTER MU}": "u",
        "\N{DEGREE SIGN}": "deg",
        "\N{DEGREE CELSIUS}": "degC",
        "\N{DEGREE FAHRENHEIT}": "degF",
        "\N{OHM SIGN}": "Ohm",
        "\N{GREEK CAPITAL LETTER OMEGA}": "Ohm",
        "\N{SUPERSCRIPT MINUS}": "-",
        "\N{MINUS SIGN}": "-",
        "\N{MIDDLE DOT}": ".",
        "\N{DOT OPERATOR}": ".",
        "\N{LATIN SMALL LETTER SHARP S}": "ss",
        "\N{LATIN SMALL LETTER O WITH STROKE}": "o",
        "\N{LATIN CAPITAL LETTER O WITH STROKE}": "O",
    }
)
"""What has a spelling in ASCII; accents and raised figures have one by Unicode's decomposition."""


def write_uff(path: Path, streams: Sequence[RecordedStream], about: Mapping[str, str]) -> list[str]:
    """Write all channels, in float64; a missing sample is 0, as pyuff writes no NaN.

    The first header line is the sensor, the second stream and machine, the third the begin to a second. The
    fourth has it to a nanosecond and the rate, which the abscissa has to six digits only. Texts are ASCII:
    what has a spelling there gets it (um, degC, m/s2).

    Returns:
        How many samples are 0 that were missing or infinite, and which names and units are not as they were,
        in sentences.
    """
    import pyuff  # noqa: PLC0415 - an extra, and only this format needs it

    file = pyuff.UFF(str(path))
    numbered = [(s, column) for s in range(len(streams)) for column in range(len(streams[s].names))]
    lines = _names([streams[s].names[column] for s, column in numbered])
    infinite = [0] * len(streams)
    notes = []
    for node, ((s, column), line) in enumerate(zip(numbered, lines, strict=True), 1):
        stream = streams[s]
        name, unit = stream.names[column], stream.units[column]
        label = _line(unit, LONGEST_LABEL) or "NONE"
        notes += _notes_on_texts(path, name, line, unit, label)
        started = f"{STATED_START} = {stream.start}, " if stream.start else ""
        finite, replaced = filled(stream.samples[:, column], np.float64)
        infinite[s] += replaced
        data_set = pyuff.prepare_58(
            binary=1,
            func_type=TIME_RESPONSE,
            id1=line,
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
            ordinate_spec_data_type=QUANTITIES.get(label, UNKNOWN),
            ordinate_axis_units_lab=label,
            orddenom_spec_data_type=UNKNOWN,
            # Only the first two are examined, of steps that are even.
            x=np.array([0.0, 1.0 / stream.rate_hz]),
            data=finite,
        )
        data_set["ordinate_axis_lab"] = line[:LONGEST_LABEL]
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ResourceWarning)  # of binary files pyuff leaves one open
            try:
                file.write_sets(data_set, "add")
            except Exception as error:
                # pyuff states of whatever goes wrong that it went wrong.
                if isinstance(error.__context__, OSError):
                    raise error.__context__ from None
                raise
    return notes_on_gaps(path, streams, "UFF", infinite) + notes


def _names(names: Sequence[str]) -> list[str]:
    """First lines of the headers: each once, as who reads them knows the channels by no other."""
    # NONE represents no line at all; short enough for a number behind.
    lines = [_line(name, LONGEST - 6) for name in names]
    return unique(["channel" if line.upper() in {"", "NONE"} else line for line in lines])


def _notes_on_texts(path: Path, name: str, line: str, unit: str, label: str) -> list[str]:
    """What a header does not state as the recording does; a unit in other letters is the same unit."""
    notes = []
    if line != name:
        notes.append(f"{path.name}: channel {name} is called {line} there, as a UFF file has ASCII names")
    if unit and (label != _ascii(unit) or "?" in label.replace("?", "", unit.count("?"))):
        notes.append(
            f"{path.name}: the unit {unit} of channel {name} is {label} there, as a UFF file has ASCII units "
            f"of {LONGEST_LABEL} characters"
        )
    return notes


def _ascii(text: str) -> str:
    """Text in ASCII, its letters without accents; a question mark where a letter has no other spelling."""
    spelled = unicodedata.normalize("NFKD", text.translate(SPELLED))
    plain = "".join(letter for letter in spelled if not unicodedata.combining(letter))
    return " ".join(plain.translate(SPELLED).encode("ascii", "replace").decode().split())


def _line(text: str, longest: int = LONGEST) -> str:
    """Text as the format takes it, which is ASCII."""
    return _ascii(text)[:longest].strip()


def _date(start_ns: int | None) -> str:
    if start_ns is None:
        return "NONE"
    return f"{datetime.fromtimestamp(start_ns // 1_000_000_000, UTC):%d-%b-%y %H:%M:%S}"
