"""The page of the codes that messages end with."""

from __future__ import annotations

from typing import TYPE_CHECKING

from daqsvc.errors.table import CODES, GROUPS, group_title
from daqsvc.reference.markdown import anchored, code, page

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

_ABOUT = """A message ends with a code, e.g. `[F01]`. It means one kind of mistake or fault, and is never
used for another. `daqsvc explain F01` prints what is written here. The message itself names the thing, its
value and what to do; here is what leads to it. Messages of plugins that are not part of daqsvc may have no
code, or one that begins with [two letters or more](../write-a-driver.md#codes-of-messages), which
`daqsvc explain` knows where the package is installed."""


def gaps() -> Iterator[str]:
    """Nothing: a code cannot be made without words."""
    return iter(())


def pages() -> Mapping[str, str]:
    """The page, by its file name; a link to a code ends with it, as in ``errors.md#f01``."""
    blocks = []
    for letter in GROUPS:
        blocks.append(f"## {letter}: {group_title(letter)}")
        for one in CODES.values():
            if one.id.startswith(letter):
                heading = anchored(f"### {one}: {one.title}", one.id.lower())
                blocks += [heading, one.cause]
                if one.example:
                    blocks.append(f"Example: {code(one.example)}")
                # The pages of the reference lie beside this one.
                file = f"../{one.page}".replace("../reference/", "")
                blocks.append(f"What to do: {one.remedy} See [{one.page}]({file}).")
    return {"errors.md": page("Errors and their codes", _ABOUT, *blocks)}
