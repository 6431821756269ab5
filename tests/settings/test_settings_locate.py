"""The locator against tomllib: the same keys, and the lines on which the writer of the text put them."""

from __future__ import annotations

import json
import re
import tomllib

import pytest
from hypothesis import given
from hypothesis import strategies as st

from daqsvc.settings.locate import locate

pytestmark = pytest.mark.property
KEYS = st.sampled_from(
    ["a", "b", "rate_hz", "10", "x-y", "with.dot", "ä ö", "#", "", "[t]", 'q"q', "\\", "="]
)
SCALARS = st.one_of(
    st.sampled_from(
        [
            "1",
            "-1_000",
            "0x1F",
            "1e-3",
            "nan",
            "true",
            "1979-05-27 07:32:00Z",
            "07:32:00",
            "''",
            '""',
            '"# no comment"',
            "'] } ='",
            '"\\"]"',
            "'C:\\'",
            '"""one \\\n   two"""',
            '"""\nthree ] \\""" four"""',
            '""""quoted""""',
            '"""a""b"""""',
            "'''\nfive\n'''",
            "''''six''''",
        ]
    ),
    st.integers().map(str),
    st.text(st.characters(exclude_categories=["Cc", "Cs"]), max_size=8).map(
        lambda text: json.dumps(text, ensure_ascii=False)
    ),
)
VALUES = st.recursive(
    SCALARS.map(lambda text: ("scalar", text)),
    lambda inner: st.one_of(
        st.tuples(st.just("array"), st.lists(inner, max_size=3), st.booleans()),
        st.tuples(st.just("inline"), st.dictionaries(KEYS, inner, max_size=3), st.booleans()),
    ),
    max_leaves=6,
)
PAIRS = st.dictionaries(KEYS, VALUES, max_size=3)
TABLES = st.recursive(
    PAIRS.map(lambda pairs: (pairs, {})),
    lambda inner: st.tuples(
        PAIRS, st.dictionaries(KEYS, st.one_of(inner, st.lists(inner, min_size=1, max_size=3)), max_size=3)
    ),
    max_leaves=6,
)


class Writer:
    """Writes a document and notes where."""

    def __init__(self, draw_bool, newline):
        self.text = ""
        self.lines = {}
        self.flip = draw_bool
        self.newline = newline

    @property
    def line(self):
        return self.text.count("\n") + 1

    def end_line(self):
        if self.flip():
            self.text += " # [not] = a table"
        self.text += self.newline
        if self.flip():
            self.text += f"  {self.newline}"

    def key(self, key):
        return (
            key
            if re.fullmatch(r"[A-Za-z0-9_-]+", key) and self.flip()
            else json.dumps(key, ensure_ascii=False)
        )

    def table(self, table, path, named):
        pairs, tables = table
        for key, value in pairs.items():
            if key in tables:
                continue
            self.pair(key, value, path)
            self.end_line()
        for key, inner in tables.items():
            several = isinstance(inner, list)
            for index, one in enumerate(inner if several else [inner]):
                at = (*path, key, index) if several else (*path, key)
                parts = " . ".join(self.key(part) for part in [*named, key])
                self.lines.setdefault((*path, key), self.line)
                self.lines[at] = self.line
                self.text += f"[[ {parts} ]]" if several else f"  [{parts}]"
                self.end_line()
                self.table(one, at, [*named, key])

    def pair(self, key, value, path):
        self.lines[*path, key] = self.line
        if value[0] == "inline" and len(value[1]) == 1 and value[2]:  # a.b = ... means the same table
            ((inner, below),) = value[1].items()
            self.text += f"{self.key(key)}. "
            self.pair(inner, below, (*path, key))
            return
        self.text += f"{self.key(key)} = "
        self.value(value, (*path, key))

    def value(self, value, path):
        if value[0] == "scalar":
            self.text += value[1]
        elif value[0] == "inline":
            self.text += "{ "
            for index, (key, inner) in enumerate(value[1].items()):
                self.text += ", " if index else ""
                self.pair(key, inner, path)
            self.text += " }"
        else:
            spread = value[2]
            self.text += "["
            for index, inner in enumerate(value[1]):
                if spread:
                    self.end_line()
                self.lines[*path, index] = self.line
                self.value(inner, (*path, index))
                self.text += ", "
            if spread:
                self.end_line()
            self.text += "]"


def leaves(value, path=()):
    if isinstance(value, dict) and value:
        for key, inner in value.items():
            yield from leaves(inner, (*path, key))
    elif isinstance(value, list) and value:
        for index, inner in enumerate(value):
            yield from leaves(inner, (*path, index))
    else:
        yield path, value


@given(TABLES, st.data(), st.sampled_from(["\n", "\r\n"]))
def test_every_key_is_found_on_the_line_where_it_was_written(table, data, newline):
    writer = Writer(lambda: data.draw(st.booleans()), newline)
    writer.table(table, (), [])
    document = tomllib.loads(writer.text)
    spots = locate(writer.text)
    found = {path: spot.line for path, spot in spots.items() if path}
    assert found == writer.lines
    for path, value in leaves(document):
        if not path or spots[path].source == "":
            assert value == {}  # a header with nothing under it
            continue
        again = tomllib.loads(f"key = {spots[path].source}")["key"]
        assert repr(again) == repr(value)


@pytest.mark.parametrize(
    ("text", "path", "line"),
    [
        ("[[a]]\n[a.b]\nx = 1\n[[a]]\n[a.b]\nx = 2\n", ("a", 1, "b", "x"), 6),
        ("[a.b.c]\nx = 1\n[a]\ny = 2\n", ("a", "y"), 4),
        ("[a.b.c]\nx = 1\n[a]\ny = 2\n", ("a",), 1),
        ("a.b = 1\na.c = 2\n", ("a", "c"), 2),
        ("x = [ # one\n  1, # two\n  [2,\n   3],\n]\n", ("x", 1, 1), 4),
        ("x = 1", ("x",), 1),
    ],
)
def test_places_that_are_easily_got_wrong(text, path, line):
    assert locate(text)[path].line == line
