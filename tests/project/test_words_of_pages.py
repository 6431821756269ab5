"""Names that pages have in backticks exist: keys, options, counters, metrics, fields, functions."""

from __future__ import annotations

import re
import subprocess

import pytest
from support.paths import ROOT

_NAME = re.compile(r"(?<![\w./-])[a-z][a-z0-9]*(?:_[a-z0-9]+)+(?![\w/-])|(?<![\w-])--[a-z][a-z0-9-]+")
_WORD = re.compile(r"--[a-z][a-z0-9-]+|[A-Za-z_][A-Za-z0-9_]*")
_BLOCK = re.compile(r"^ *(```|~~~).*?^ *\1$", re.MULTILINE | re.DOTALL)
_TICKS = re.compile(r"(?<!`)`([^`\n]+)`(?!`)")
_HAVE_NAMES = ("daqsvc/", "drivers/", "sim_hw/", "tests/", "config/", "packaging/", "docs/reference/")
_OF_OTHERS = {
    "accel_g": "a channel of an example",
    "autosave_interval": "Mosquitto",
    "buffer_strategy": "Telegraf",
    "hive_partitioning": "DuckDB",
    "pg_hba": "PostgreSQL",
    "purge_keep_days": "Home Assistant",
}


def _files() -> list[str]:
    found = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=True)
    return [name for name in found.stdout.splitlines() if (ROOT / name).is_file()]


def pages() -> list[str]:
    return [
        name
        for name in _files()
        if name.endswith(".md")
        and name != "CHANGELOG.md"
        and (name.startswith("docs/") or "/" not in name)
        and not name.startswith(("docs/reference/", "docs/decisions/"))
    ]


@pytest.fixture(scope="module")
def known() -> set[str]:
    """Every word of the code, and of what is made of it."""
    this = str(__file__).removeprefix(f"{ROOT}/")
    words: set[str] = set(_OF_OTHERS)
    for name in _files():
        if name == this or not (name.startswith(_HAVE_NAMES) or "." not in name or name.endswith(".toml")):
            continue
        words.update(_WORD.findall((ROOT / name).read_bytes().decode("utf-8", "replace")))
        words.add(name.rsplit("/", 1)[-1].split(".")[0])
    return words


def unknown(text: str, known: set[str]) -> set[str]:
    """Names in backticks that are nowhere else; those of the page's own blocks are tested with them."""
    of_blocks = {word for block in _BLOCK.finditer(text) for word in _WORD.findall(block[0])}
    named = {name for ticks in _TICKS.finditer(_BLOCK.sub("", text)) for name in _NAME.findall(ticks[1])}
    return named - known - of_blocks


@pytest.mark.parametrize("page", pages())
def test_names_of_a_page_exist(page, known):
    assert unknown((ROOT / page).read_text(encoding="utf-8"), known) == set()


def test_a_name_that_is_nowhere_is_found(known):
    text = (
        "The key `befor_s` and `chatter_windows_s = 3`, the option `--regs`; `on_delay_s`, `--registers 1-3`."
    )
    wrong = {"befor" + "_s", "chatter_windows" + "_s", "--" + "regs"}
    assert unknown(text, known - wrong) == wrong
    assert unknown("```\nown_name = 1\n```\nIts `own_name`.", known) == set()
