"""NOTICE: the level of the log between INFO and WARNING, for good news and for what somebody asked for.

INFO is not shown by default. Who has read a warning must also read that it is over. A warning would be the
wrong level for that: from WARNING on, each line is about a fault and ends with a code (`daqsvc.errors`).
NOTICE is the ``notice`` of syslog(3) and of systemd's journal, priority 5: normal, but significant.
"""

from __future__ import annotations

import logging

NOTICE = 25

logging.addLevelName(NOTICE, "NOTICE")


def notice(logger: logging.Logger, message: str, *arguments: object) -> None:
    """Log at the level NOTICE, as ``logger.warning(message, *arguments)`` does at its own.

    Args:
        logger: of the module that has news.
        message: with the placeholders of `logging`, e.g. ``"%s is back"``.
        arguments: for the placeholders.
    """
    logger.log(NOTICE, message, *arguments, stacklevel=2)
