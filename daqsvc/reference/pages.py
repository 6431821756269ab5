"""All pages together, and the list of them."""

from __future__ import annotations

from typing import TYPE_CHECKING

from daqsvc.reference import alarms, counters, errors, formats, keys, messages, metrics, process, verbs
from daqsvc.reference.markdown import NOTE, WordsMissingError, page

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

_MAKERS = (keys, verbs, counters, metrics, messages, formats, alarms, process, errors)
LIST = "README.md"


def gaps() -> list[str]:
    """What users see and nothing describes, and where to write the words."""
    return [gap for maker in _MAKERS for gap in maker.gaps()]


def pages(directory: Path) -> dict[str, str]:
    """Text of each page, by file name.

    Args:
        directory: where they go; pages that are kept there by hand are in the list, too.

    Raises:
        WordsMissingError: something has no words.
    """
    if missing := gaps():
        raise WordsMissingError(missing)
    made = {name: text for maker in _MAKERS for name, text in maker.pages().items()}
    texts = {path.name: path.read_text(encoding="utf-8") for path in directory.glob("*.md")}
    others = {name: text for name, text in texts.items() if NOTE not in text}
    return {LIST: _list({**others, **made}), **made}


def write(directory: Path) -> None:
    """Write the pages into a directory, and take away those of ours that are no more.

    Raises:
        WordsMissingError: something has no words.
    """
    made = pages(directory)
    directory.mkdir(parents=True, exist_ok=True)
    for old in directory.glob("*.md"):
        if old.name not in made and NOTE in old.read_text(encoding="utf-8"):
            old.unlink()
    for name, text in made.items():
        (directory / name).write_text(text, encoding="utf-8")


def _list(texts: Mapping[str, str]) -> str:
    first = {name: number for number, name in enumerate(_FIRST)}
    ordered = sorted(
        texts, key=lambda name: (first.get(name, len(first)), not name.startswith("keys-"), name)
    )
    lines = [f"- [{_title(texts[name])}]({name})" for name in ordered]
    return page("Reference from the code", _ABOUT, "\n".join(lines))


_FIRST = (
    "keys.md",
    "verbs.md",
    "process.md",
    "errors.md",
    "alarms.md",
    "topics.md",
    "payloads.md",
    "formats.md",
    "counters.md",
    "metrics.md",
)


def _title(text: str) -> str:
    """The heading of a page; brackets in it would end a link."""
    return text.partition("\n")[0].removeprefix("# ").translate(str.maketrans("", "", "`[]"))


_ABOUT = """What daqsvc has, from the code by `make reference`: every key, verb, option, counter, metric,
topic and field, with the exact names as they are in files and messages."""
