"""Text logs of CAN frames, read by python-can line by line: a line that is no frame costs itself and no more.

python-can checks little: a bad line makes its reader fail wherever it happens to, and a reader that has
failed is at its end. So the reader is begun again behind the line.
"""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Final

from can.io import ASCReader, TRCReader
from can.io.canutils import CanutilsLogReader
from can.util import len2dlc

from drivers.can.errors import BUS_ERROR

if TYPE_CHECKING:
    from collections.abc import Iterator
    from typing import TextIO

    import can
    from can.io.generic import TextIOMessageReader

LONGEST_LINE = 4096
"""No line of a log is longer, in characters."""
MOST_WITHOUT_FRAME = 100_000
"""Lines in a row that are no frames, after which a log is given up: a thread waits for the next frame."""
_SHOWN = 60
LATEST_S = 9e9
"""No recording is later than the year 2255; nanoseconds of it still are integers of 64 bits."""

_NEVER = re.compile(r"(?!)")
_IN_HEADER: Final[dict[type[TextIOMessageReader], re.Pattern[str]]] = {
    CanutilsLogReader: _NEVER,
    ASCReader: re.compile(""),
    TRCReader: re.compile(";"),
}
"""Of the lines that a reader takes before its first frame, those that state how to read the others."""


class TextLog:
    """The frames in a text log.

    Args:
        file: the log, open.
        reader: python-can's reader of its format.

    Attributes:
        malformed: lines that were no frames, so far.
        first_malformed: the first of them, quoted; empty while there is none.
        first_malformed_at: its number, from 1.
    """

    def __init__(self, file: TextIO, reader: type[TextIOMessageReader]) -> None:
        self.malformed = 0
        self.first_malformed = ""
        self.first_malformed_at = 0
        self._lines = _Lines(file, _IN_HEADER.get(reader))
        self._reader = reader

    def __iter__(self) -> Iterator[can.Message]:
        """The frames.

        Raises:
            Exception: the file cannot be read on, whatever its decompression raises then.
        """
        while True:
            begun_at = self._lines.number
            try:
                for message in self._reader(self._lines):  # type: ignore[arg-type]
                    yield whole(message)
                    self._lines.without_frame = 0
            except Exception:
                # A reader that fails at the header, which it is given again, would do so for ever.
                stuck = self._lines.number == begun_at
                if self._lines.broken or not self._lines.can_go_on or stuck:
                    raise
                if not self.malformed:
                    self.first_malformed, self.first_malformed_at = self._lines.quoted, self._lines.number
                self.malformed += 1
                self._lines.read_header_again()
            else:
                return

    def close(self) -> None:
        """Close the file."""
        self._lines.close()


class _Lines:
    """The lines of a file, of which a reader begun later sees the header again, and then what is left."""

    _ERROR_FRAME = re.compile(r" ([2367ABEF][0-9A-F]{7})#", re.IGNORECASE)

    def __init__(self, file: TextIO, in_header: re.Pattern[str] | None) -> None:
        self.close = file.close
        self.broken = False
        self.can_go_on = in_header is not None
        self._file = file
        self._in_header = in_header or _NEVER
        self._header: list[str] = []
        self._again: list[str] = []
        self._loops = 0
        self.without_frame = 0
        self.number = 0
        self._line = ""

    @property
    def quoted(self) -> str:
        """The line that was read last, cut if it is long."""
        line = self._line.strip()
        return repr(line if len(line) <= _SHOWN else f"{line[:_SHOWN]}...")

    def read_header_again(self) -> None:
        """Begin with the header again."""
        self._again = self._header.copy()

    def __iter__(self) -> _Lines:
        # A reader takes the header in its own loop, which is its first.
        self._loops += 1
        return self

    def __next__(self) -> str:
        if self._again:
            return self._again.pop(0)
        try:
            line = self._file.readline(LONGEST_LINE)
        except Exception:
            self.broken = True
            raise
        if not line:
            raise StopIteration
        self.number += 1
        self.without_frame += 1
        if self.without_frame > MOST_WITHOUT_FRAME:
            self.broken = True
            raise ValueError(f"{MOST_WITHOUT_FRAME:,} lines in a row are no frames")
        self._line = line
        if self._loops == 1 and self._in_header.match(line):
            self._header.append(line)
        # python-can knows only bus errors as error frames: here every error frame is one.
        return self._ERROR_FRAME.sub(self._as_bus_error, line, count=1)

    @staticmethod
    def _as_bus_error(match: re.Match[str]) -> str:
        return f" {int(match[1], 16) | BUS_ERROR:08X}#"


def whole(message: can.Message) -> can.Message:
    """A message, if it is one that can have been on a bus.

    Raises:
        ValueError: its time stamp is beyond all times, or it has more or fewer bytes than it states.
    """
    if not abs(message.timestamp) < LATEST_S:
        raise ValueError(f"a time stamp of {message.timestamp:.10g} s, which is no time")
    length = len(message.data)
    if length > 64:
        raise ValueError(f"{length} bytes of data")
    # Of a CAN FD frame some of python-can's readers give the code of its length.
    if not message.is_remote_frame and message.dlc not in {length, len2dlc(length)}:
        raise ValueError(f"{length} bytes of data where {message.dlc} are announced")
    return message
