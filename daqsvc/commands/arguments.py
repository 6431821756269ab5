"""The parser of the command line: what is wrong is said in one line, the usage only where it is asked for."""

from __future__ import annotations

import argparse
import re
from typing import Any, NoReturn

EXIT_BAD_ARGUMENTS = 2


class ArgumentParser(argparse.ArgumentParser):
    """A parser whose errors are one line; so are those of its verbs."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        # "-5m" is a wrong value, and not an option that nobody knows.
        self._negative_number_matcher = re.compile(r"-\.?\d")

    def error(self, message: str) -> NoReturn:
        """Say what is wrong and where help is, and exit with 2."""
        self.exit(EXIT_BAD_ARGUMENTS, f"{self.prog}: {message}; see {self.prog} --help\n")
