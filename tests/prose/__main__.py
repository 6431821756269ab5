"""Is all prose plain English? ``make check`` asks this of pages, messages, docstrings and comments.

::

    PYTHONPATH=tests python -m prose                  # everything
    PYTHONPATH=tests python -m prose docs/alarms.md   # some files

Prints file, line and what to write instead; exit code 1 if there is anything to mend. The words and limits
are in `vocabulary.toml`.
"""

from __future__ import annotations

import sys
from pathlib import Path

from prose.rules import findings, prose_files


def main(arguments: list[str]) -> int:
    """Print what is to be mended."""
    files = [Path(name).resolve() for name in arguments] or prose_files()
    found = findings(files)
    for finding in found:
        sys.stdout.write(f"{finding}\n")
    if found:
        sys.stdout.write(f"{len(found)} places to mend; tests/prose/vocabulary.toml has the rules\n")
    return bool(found)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
