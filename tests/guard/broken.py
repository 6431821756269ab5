"""Machine files that are wrong: every table of the examples spoilt in five ways, and what contradicts itself.

`spoilt` covers keys: in each table of each kind all names are misspelt, all values of the wrong type, all
beyond their bounds, all below them, or missing. ``check`` reports all errors at once, so that one file covers
a whole table. `test_guard.py` sees that no key of any settings model is left out.

`contradictions.json` covers what is valid key by key: edits of the examples, gathered from the unit tests of
the settings by ``python -m guard.gather``, one for each message that there is. It is written once and then
kept, so that the same files are read before and after a change of the code.
"""

from __future__ import annotations

import json
import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from guard.tables import KIND_KEYS, Key, headers, label, tables

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence

CONTRADICTIONS = Path(__file__).with_name("contradictions.json")
_LARGE, _UNKNOWN = 10_000_000_000_000, "zzz_unknown"


@dataclass(frozen=True)
class Broken:
    """A machine file that is wrong.

    Attributes:
        name: what was done, and to what.
        machine: name of the file that it was made of.
        text: its text.
    """

    name: str
    machine: str
    text: str


def spoilt(texts: Mapping[str, str]) -> Iterator[Broken]:
    """Every kind of table in every way; of several tables of a kind those that have keys of their own.

    Args:
        texts: of machine files that can be used, by name.
    """
    for title, (machine, held) in _specimens(texts).items():
        text = texts[machine]
        for way, change in _WAYS.items():
            edits = [edit for key in held if (edit := change(key, text)) is not None]
            if edits:
                yield Broken(f"{way}: {title}", machine, _edited(text, edits))
        unknown = f"{_UNKNOWN} = 1" + (", " if held[0].inline else "\n")
        edits = [_removed(key, text) for key in held if key.name not in KIND_KEYS]
        yield Broken(
            f"missing: {title}", machine, _edited(text, [*edits, (held[0].begin, held[0].begin, unknown)])
        )
        for key in held:
            if key.name in KIND_KEYS and isinstance(key.value, str):
                yield Broken(f"without {key.name}: {title}", machine, _edited(text, [_removed(key, text)]))
                yield Broken(
                    f"unknown {key.name}: {title}",
                    machine,
                    _edited(text, [_replaced(key, '"no-such-thing"')]),
                )

    yield from _spoilt_headers(texts)


def _spoilt_headers(texts: Mapping[str, str]) -> Iterator[Broken]:
    """Every kind of table that has a header: misspelt, and left out with all that is in it."""
    done: set[str] = set()
    for machine, text in texts.items():
        document = tomllib.loads(text)
        there = headers(text)
        for number, header in enumerate(there):
            title = label(document, header.path)
            if title in done:
                continue
            done.add(title)
            last = header.name_end
            yield Broken(f"misspelt header: {title}", machine, _edited(text, [(last - 1, last, "")]))
            names = header.path
            inside = [one for one in there[number + 1 :] if one.path[: len(names)] != names]
            end = inside[0].begin if inside else len(text)
            yield Broken(f"left out: {title}", machine, _edited(text, [(header.begin, end, "")]))


def _specimens(texts: Mapping[str, str]) -> dict[str, tuple[str, list[Key]]]:
    """Tables to spoil, by title: of each kind the one with most keys, and others that have more keys."""
    kinds: dict[str, list[tuple[str, list[Key]]]] = {}
    for machine, text in texts.items():
        for title, held in tables(text):
            kinds.setdefault(title or "top level", []).append((machine, held))
    found: dict[str, tuple[str, list[Key]]] = {}
    for title, those in kinds.items():
        covered: set[str] = set()
        for machine, held in sorted(those, key=lambda one: (-len(one[1]), one[0])):
            names = {key.name for key in held}
            if names - covered:
                found[f"{title} ({len(covered)} keys before)" if covered else title] = (machine, held)
                covered |= names
    return found


def covered(texts: Mapping[str, str]) -> dict[str, set[str]]:
    """Keys that `spoilt` spoils, by kind of table."""
    found: dict[str, set[str]] = {}
    for text in texts.values():
        for title, held in tables(text):
            found.setdefault(title, set()).update(key.name for key in held)
        document = tomllib.loads(text)
        for header in headers(text):
            # A table with a header is a key of the table that it stands in.
            names = [step for step in header.path if isinstance(step, str)]
            found.setdefault(label(document, header.path[: header.path.index(names[-1])]), set()).add(
                names[-1]
            )
            found.setdefault("", set()).add(names[0])
    return found


Edit = tuple[int, int, str]
"""Replace the text from here to there by this."""


def _edited(text: str, edits: Sequence[Edit]) -> str:
    for begin, end, new in sorted(edits, reverse=True):
        text = text[:begin] + new + text[end:]
    return text


def _replaced(key: Key, new: str) -> Edit:
    return key.value_begin, key.end, new


def _removed(key: Key, text: str) -> Edit:
    end = key.end
    if key.inline:
        rest = text[end:]
        blank = len(rest) - len(rest.lstrip())
        end += blank + 1 if rest.lstrip().startswith(",") else 0
    return key.begin, end, ""


def _misspelt(key: Key, _text: str) -> Edit | None:
    name = key.name[0] + key.name[2:] if len(key.name) > 3 else f"{key.name}x"
    return (key.begin, key.name_end, name) if key.name not in KIND_KEYS else None


def _wrong_type(key: Key, _text: str) -> Edit | None:
    if key.name in KIND_KEYS and isinstance(key.value, str):
        return None
    return _replaced(key, "17" if isinstance(key.value, str | list | dict) else '"lots"')


def _beyond(key: Key, _text: str) -> Edit | None:
    match key.value:
        case str() if key.name not in KIND_KEYS:
            return _replaced(key, '"no such thing!"')
        case _:
            return _numbers(key, _LARGE)


def _below(key: Key, _text: str) -> Edit | None:
    match key.value:
        case str() if key.name not in KIND_KEYS:
            return _replaced(key, '""')
        case []:
            return None
        case [str() | dict(), *_]:
            return _replaced(key, "[]")
        case _:
            return _numbers(key, -_LARGE)


def _numbers(key: Key, to: int) -> Edit | None:
    """All numbers of a value made ``to``; None if it is none and holds none."""

    def made(value: Any) -> Any:
        if isinstance(value, list):
            return [made(one) for one in value]
        if isinstance(value, bool) or not isinstance(value, int | float):
            return value
        return float(to) if isinstance(value, float) else to

    if isinstance(key.value, dict) or (new := made(key.value)) == key.value:
        return None
    if isinstance(key.value, list) and any(isinstance(one, dict | str) for one in key.value):
        return None
    return _replaced(key, json.dumps(new))


_WAYS: Mapping[str, Callable[[Key, str], Edit | None]] = {
    "misspelt": _misspelt,
    "wrong type": _wrong_type,
    "beyond bounds": _beyond,
    "below bounds": _below,
}


class OutdatedError(Exception):
    """An edit does not fit the file any more that it was made for."""


def contradictions(texts: Mapping[str, str]) -> Iterator[Broken]:
    """The machine files of `CONTRADICTIONS`.

    Raises:
        OutdatedError: see there.
    """
    for case in json.loads(CONTRADICTIONS.read_text(encoding="utf-8")):
        text = texts[case["machine"]]
        for old, new in case["edits"]:
            if old not in text:
                raise OutdatedError(
                    f"{CONTRADICTIONS.name}: {case['name']!r} replaces {old!r}, "
                    f"which {case['machine']} no longer has; write what stands there now"
                )
            text = text.replace(old, new, 1)
        yield Broken(case["name"], case["machine"], text)
