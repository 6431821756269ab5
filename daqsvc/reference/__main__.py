"""Writes the pages: ``python -m daqsvc.reference DIR``."""

from __future__ import annotations

import sys
from pathlib import Path

from daqsvc.reference.markdown import WordsMissingError
from daqsvc.reference.pages import write


def main(arguments: list[str]) -> int:
    """Write the pages into the directory that is named; 1 if something has no words."""
    if len(arguments) != 1:
        sys.stderr.write("usage: python -m daqsvc.reference DIR\n")
        return 2
    try:
        write(Path(arguments[0]))
    except WordsMissingError as error:
        sys.stderr.write("".join(f"{gap}\n" for gap in error.gaps))
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
