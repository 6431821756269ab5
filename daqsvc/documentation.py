"""How texts of the program name a page of its documentation.

A user of the package has the site and not the files of ``docs/``. So a page goes by its title, which is in
the contents and is found by the search.
"""

from __future__ import annotations

TITLES = {
    "alarms": "Alarms",
    "fleet": "The archive of a fleet",
    "machine-file": "Machine file: what daqsvc check checks",
    "page": "The page",
    "reference/counters": "Counters and figures of the status",
    "reference/keys": "Keys of the machine file",
    "serial": "Serial ports",
}
"""Titles of the pages that texts name, by the path below ``docs/``."""


def documented_in(page: str) -> str:
    """Where to read more: ``"The page" in the documentation``.

    Args:
        page: a path of `TITLES`.
    """
    return f'"{TITLES[page]}" in the documentation'
