"""The parser of the command line, and the exit codes of its verbs.

What is wrong is said in one line, the usage only where it is asked for.
"""

from __future__ import annotations

import argparse
import re
from typing import Any, NoReturn

EXIT_OK = 0
EXIT_FAILED = 1
EXIT_USAGE = 2
"""Wrong arguments, or a machine file that cannot be used."""
EXIT_REFUSED = 3
"""Of `analyze` and `calibrate`: a recording cannot be judged."""
EXIT_LOST = 3
"""Of `run`: something without which the service is useless was lost while it ran."""
EXIT_HUNG = 4
"""Of `run`: something hung while the service stopped."""
EXIT_STUCK = 5
"""Of `run`: the event loop stood still."""


class ArgumentParser(argparse.ArgumentParser):
    """A parser whose errors are one line; so are those of its verbs."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        # "-5m" is a wrong value, and not an option that nobody knows.
        self._negative_number_matcher = re.compile(r"-\.?\d")

    def error(self, message: str) -> NoReturn:
        """Say what is wrong and where help is, and exit with 2."""
        self.exit(EXIT_USAGE, f"{self.prog}: {message}; see {self.prog} --help\n")
