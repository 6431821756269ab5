"""Defaults that the pages state in their text are those of the code. The reference is made from it anyway."""

from __future__ import annotations

import re
import tomllib
from typing import TYPE_CHECKING, Any, NamedTuple

import pytest
from support.paths import ROOT
from support.snippets import snippets

from daqsvc.reference.keys import tables
from daqsvc.reference.verbs import options, parsers

if TYPE_CHECKING:
    from collections.abc import Iterator

pytestmark = [pytest.mark.unit, pytest.mark.sources]
DOCS = ROOT / "docs"
PAGES = [*sorted(DOCS.glob("*.md")), *sorted((DOCS / "tutorials").glob("*.md")), ROOT / "README.md"]

VALUE = r'`?(?P<value>"?-?[\w.:]+"?)`?'
SENTENCE = re.compile(rf"`(?P<name>[\w-]+)`(?:[^`.|]|`\[[^`]*`)*?[\s,(]{VALUE}(?: [A-Za-z]+)? by default")
BRACKETS = re.compile(r"\| `(?P<name>--[\w-]+)[^|`]*` \|[^|\n]*\(default: (?P<value>[\w.]+)\)")
CHOICE = re.compile(rf"\| `(?P<name>--[\w-]+)[^|`]*` \|[^|\n]*?{VALUE} \(default\)")
REMARK = re.compile(r"^(?P<name>\w+) = (?P<value>\S+) +# the default\b", re.MULTILINE)
REMARK_ON_CHOICE = re.compile(r'^(?P<name>\w+) = .*?# .*(?P<value>"[\w-]+") \(the default\)', re.MULTILINE)
LINE = re.compile(r"`(?P<name>\w+) = (?P<value>[^`]+)` \(the default\)")
FORMS = (SENTENCE, BRACKETS, CHOICE, REMARK, REMARK_ON_CHOICE, LINE)

WHOLE_BLOCKS = {
    "alarms.md": (
        "[alarm_handling]                 # for all alarms; these are the defaults",
        "alarm_handling",
    ),
    "outbox.md": ("[store]", "store"),
    "modbus.md": ("demotion_s = 10.0", "buses.NAME"),
    "serial.md": ('framing = "lines"                # or "cobs"', "buses.NAME"),
}
"""Blocks with the default of each key that has one: by the page, a line of the block, and the table."""


class Stated(NamedTuple):
    """A default on a page: of a key or an option, and its value as text."""

    page: str
    name: str
    value: str


def stated() -> Iterator[Stated]:
    for page in PAGES:
        text = page.read_text("utf-8")
        for form in FORMS:
            for found in form.finditer(text):
                yield Stated(page.name, found["name"], found["value"])


def same(text: str, value: Any) -> bool:
    try:
        return bool(tomllib.loads(f"v = {text}")["v"] == value)
    except tomllib.TOMLDecodeError:
        return text == value


def defaults_of_keys(name: str) -> Iterator[Any]:
    for table in tables().values():
        for variant in table.keys.get(name, []):
            default = variant.field.get_default(call_default_factory=False)
            yield from default if isinstance(default, tuple) else (default,)


def defaults_of_options(name: str) -> Iterator[Any]:
    for verb, _ in parsers():
        for _, action in options(verb):
            if name in action.option_strings:
                yield action.default
                # Not known before others are: in the words of the help.
                for words in re.findall(r"\(default: ([^)]*)\)", action.help or ""):
                    yield from re.findall(r"[\w.]+", words)


@pytest.mark.parametrize("one", [pytest.param(one, id=f"{one.page}-{one.name}") for one in stated()])
def test_a_stated_default_is_that_of_the_code(one: Stated) -> None:
    of_code = list((defaults_of_options if one.name.startswith("--") else defaults_of_keys)(one.name))
    assert any(same(one.value, value) for value in of_code), of_code


@pytest.mark.parametrize("page", WHOLE_BLOCKS)
def test_a_block_of_defaults_is_that_of_the_code(page: str) -> None:
    line, path = WHOLE_BLOCKS[page]
    (block,) = [one for one in snippets(DOCS / page) if line in one.text and one.language == "toml"]
    keys, compared = tables()[path].keys, 0
    held: Any = tomllib.loads(block.text)
    for part in path.split("."):
        held = next(iter(held.values())) if part == "NAME" else held[part]
    kind = {held.get("driver"), held.get("transport")} - {None}
    for name, value in held.items():
        variants = [v for v in keys[name] if not v.kind or not kind or any(k in v.kind for k in kind)]
        known = [v.field.get_default() for v in variants or keys[name] if not v.field.is_required()]
        if not isinstance(value, (dict, list)) and known and name not in {"transport", "framing", "baud"}:
            assert value in known or known == [None], name
            compared += 1
    assert compared >= 4


@pytest.mark.parametrize("form", FORMS)
def test_each_form_is_on_a_page(form: re.Pattern[str]) -> None:
    assert any(form.search(page.read_text("utf-8")) for page in PAGES)
