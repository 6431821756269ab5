"""How a verb states on stderr what went wrong: in one line, with the code of its kind at the end."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING

from daqsvc.errors.code import with_code

if TYPE_CHECKING:
    from daqsvc.errors.code import Code


def complain(who: str, what: object, code: Code | str | None, exit_code: int = 1) -> int:
    """Say what went wrong.

    Args:
        who: the verb, as in ``daqsvc status``, or the file that it is about.
        what: a message, or the error that has it.
        code: of its kind, or its id; None where an error of a plugin from outside has none.
        exit_code: what the verb ends with.

    Returns:
        That exit code.
    """
    print(with_code(f"{who}: {what}", code), file=sys.stderr, flush=True)  # noqa: T201 - errors go to stderr
    return exit_code
