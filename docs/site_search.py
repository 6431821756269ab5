"""A Sphinx extension: the search of the site finds sections and rows of tables, by any of the words.

Sphinx finds pages that have every word. No page has every word of a message that was copied: some are
names and numbers of this machine. And a page of the reference holds hundreds of things. Here each section is
an entry, and so is each row of a table that has an anchor. ``search_questions.toml`` has what engineers ask
in words that no page has. ``site_search.js`` ranks all of them, in Sphinx's page.
"""

from __future__ import annotations

import ast
import json
import re
import tomllib
from collections import Counter
from pathlib import Path
from textwrap import shorten
from typing import TYPE_CHECKING, Any

from docutils import nodes
from site_pages import ANCHOR
from sphinx.search.en import SearchEnglish
from sphinx.util import logging

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from sphinx.application import Sphinx

SCRIPT = "site_search.js"
INDEX = "site_search_index.js"
QUESTIONS = Path(__file__).parent / "search_questions.toml"
_EXCERPT = 240
ROOT = Path(__file__).parent.parent
_log = logging.getLogger(__name__)
ERRORS = "daqsvc/errors/"
FAR_AWAY = {
    "drivers/replay/can_log.py": "B43",
    "daqsvc/alarms/rules.py": "A17",
    "daqsvc/alarms/setpoints.py": "A17",
    "daqsvc/dsp/quality/": "D21",
    "daqsvc/detectors/levels/trends.py": "D22",
    "daqsvc/acquisition/counter_sense.py": "B38",
    "daqsvc/acquisition/standing.py": "B38",
    "daqsvc/cli.py": "C01",
    "drivers/modbus/scan_report.py": "C20",
    "drivers/questions.py": "C22",
    "drivers/serial/binary.py": "B34",
    "drivers/serial/lines.py": "B34",
    "sim_hw/bus_socket.py": "B29",
}
"""Where messages are put together that have their codes elsewhere, e.g. those of alarms."""
RAISED = {"UnknownAlarmError": "C05"}
"""Codes of exceptions whose messages get them where they are caught."""
HAD = ROOT / "tests" / "errors" / "messages.txt"
"""Messages that tests have had from the program, each behind its code."""
ERRORS_PAGE = "reference/errors"
SPOKEN = {
    "drivers/can/": "sniff#can",
    "drivers/serial/": "sniff#serial-ports",
    "drivers/modbus/": "sniff#modbus",
    "daqsvc/commands/new/": "sniff",
}
"""Where is described what ``daqsvc sniff`` and ``daqsvc new`` state of a bus: messages without codes."""
SPEAKERS = re.compile(r"heard|sniff|traffic|likely|recognise|scan|source|interview|sensors")
"""Names of the modules that state it."""


def _words_apart(node: nodes.Node) -> Iterator[str]:
    """The texts of a node, without the sections and the rows within it that are entries themselves."""
    if isinstance(node, nodes.raw):
        return
    if isinstance(node, nodes.Text):
        yield node.astext()
        return
    for child in node.children:
        if not isinstance(child, nodes.section) and not _anchor(child):
            yield from _words_apart(child)
            # Paragraphs, and cells of a table, are words apart.
            yield "" if isinstance(child, nodes.Inline | nodes.Text) else " "


def _anchor(node: nodes.Node) -> str:
    """The anchor of a row of a table, if it has one."""
    if not isinstance(node, nodes.row):
        return ""
    return next((name for raw in node.findall(nodes.raw) for name in ANCHOR.findall(raw.astext())), "")


def _text(node: nodes.Node) -> str:
    return " ".join("".join(_words_apart(node)).split())


def entries(doctree: nodes.document) -> Iterator[tuple[str, str, str]]:
    """Anchor, title and text of all that can be found on a page."""
    for section in doctree.findall(nodes.section):
        title = _text(section.next_node(nodes.title) or section)
        # The heading of the page is the page.
        anchor = "" if section.parent is doctree else section["ids"][0]
        yield anchor, title, _text(section).removeprefix(title).strip()
    for row in doctree.findall(nodes.row):
        if anchor := _anchor(row):
            name, *cells = (_text(cell) for cell in row.children)
            yield anchor, name, "; ".join(filter(None, cells))


def messages() -> dict[str, set[str]]:
    """The texts of the source that go with each code: messages before figures and names are put in.

    The page of a code has one example, and a code may have twenty messages.
    """
    trees = {
        file.relative_to(ROOT).as_posix(): ast.parse(file.read_text("utf-8"))
        for package in ("daqsvc", "drivers", "sim_hw")
        for file in sorted((ROOT / package).rglob("*.py"))
    }
    found: dict[str, set[str]] = {}
    ids: dict[str, str] = {}
    for file, tree in trees.items():
        for node in tree.body if file.startswith(ERRORS) else ():
            if isinstance(node, ast.Assign) and isinstance(node.value, ast.Call) and node.value.args:
                code, example = (next(_texts(part), "") for part in (node.value.args[0], _last(node.value)))
                ids |= {target.id: code for target in node.targets if isinstance(target, ast.Name)}
                found[code] = {example}
    for file, tree in trees.items():
        for code in {code for place, code in FAR_AWAY.items() if file.startswith(place)}:
            found[code].update(_texts(tree))
        for node in ast.walk(tree) if not file.startswith(ERRORS) else ():
            # What names one code only is about it, also a whole module.
            if isinstance(node, ast.Call | ast.Raise | ast.FunctionDef | ast.ClassDef | ast.Module):
                names = {part.id for part in ast.walk(node) if isinstance(part, ast.Name)}
                if len(codes := {ids[name] for name in names & ids.keys()}) == 1:
                    found[codes.pop()].update(_texts(node))
    for code, text in (*_raised_messages(trees.values()), *_had_messages()):
        found[code].add(text)
    return found


def spoken() -> dict[str, set[str]]:
    """The texts of what ``daqsvc sniff`` and ``daqsvc new`` state, by the place that describes them."""
    coded = {text for those in messages().values() for text in those}
    found: dict[str, set[str]] = {}
    for folder, place in SPOKEN.items():
        for file in sorted((ROOT / folder).glob("*.py")):
            if SPEAKERS.search(file.stem):
                texts = {text for text in _texts(ast.parse(file.read_text("utf-8"))) if text.count(" ") > 1}
                found.setdefault(place, set()).update(texts - coded)
    return found


def _had_messages() -> Iterator[tuple[str, str]]:
    """Messages of `HAD`, each behind its code."""
    for line in HAD.read_text("utf-8").splitlines():
        code, _, message = line.partition(" ")
        # Of a mistake in a machine file the keys and values are those of one file.
        if not re.match(r"[\w-]+\.toml\b", message):
            yield code, message


def _raised_messages(trees: Iterable[ast.AST]) -> Iterator[tuple[str, str]]:
    """Texts of the exceptions of `RAISED`, each behind its code."""
    for node in (node for tree in trees for node in ast.walk(tree)):
        if isinstance(node, ast.Raise) and (code := RAISED.get(_raised(node))):
            yield from ((code, text) for text in _texts(node))


def _raised(node: ast.Raise) -> str:
    """The name of the exception."""
    made = node.exc.func if isinstance(node.exc, ast.Call) else node.exc
    return made.id if isinstance(made, ast.Name) else ""


def _last(call: ast.Call) -> ast.expr:
    """The example of a code, its last argument."""
    return call.keywords[-1].value if call.keywords else call.args[-1]


def _texts(tree: ast.AST) -> Iterator[str]:
    """The texts within, each with `|` for what is put in; no docstrings."""
    docs = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
    for node in ast.walk(tree):
        if isinstance(node, ast.JoinedStr):
            parts = (part.value if isinstance(part, ast.Constant) else "|" for part in node.values)
            yield "".join(map(str, parts))
        elif isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in docs:
            yield re.sub(r"%[-.\d]*[a-z]|\{\w*\}", "|", node.value)


def questions(places: dict[str, int], language: SearchEnglish) -> Iterator[tuple[int, list[list[str]]]]:
    """The entries that answer questions, each with the words of its questions.

    Args:
        places: number of each entry, by page and anchor.
        language: to stem the words.
    """
    for place, asked in tomllib.loads(QUESTIONS.read_text("utf-8")).items():
        if place not in places:
            _log.warning("%s: no such place: %s", QUESTIONS.name, place)
            continue
        words = ((word.lower() for word in language.split(one)) for one in asked)
        stems = ({language.stem(word) for word in these if word not in language.stopwords} for these in words)
        yield places[place], [sorted(these) for these in stems]


def _write_index(app: Sphinx, failure: Exception | None) -> None:
    """Write all entries of the site, and how often each word is in each of them."""
    if failure is not None or app.builder.format != "html":
        return
    language = SearchEnglish({})
    pages = sorted(app.env.found_docs)
    titles = [app.env.titles[page].astext() for page in pages]
    found: list[tuple[int, str, str, str]] = []
    terms: dict[str, list[tuple[int, int]]] = {}
    lengths: list[int] = []
    of_codes = messages()
    said: list[tuple[int, list[str]]] = []
    for number, page in enumerate(pages):
        for anchor, title, text in entries(app.env.get_doctree(page)):
            words = [language.stem(word) for word in language.split(f"{title} {title} {title} {text}")]
            if page == ERRORS_PAGE and (code := re.match(r"[A-Z]\d\d(?=: )", title)):
                said.append((len(found), sorted(text for text in of_codes[code[0]] if " " in text)))
            for word, times in Counter(words).items():
                terms.setdefault(word, []).append((len(found), times))
            lengths.append(len(words))
            found.append((number, anchor, title, shorten(text, _EXCERPT, placeholder=" ...")))
    index = {"pages": pages, "titles": titles, "entries": found, "lengths": lengths, "terms": terms}
    index["messages"] = said
    places = {f"{pages[one]}#{anchor}".rstrip("#"): number for number, (one, anchor, *_) in enumerate(found)}
    for place, texts in spoken().items():
        if place in places:
            said.append((places[place], sorted(texts)))
        else:
            _log.warning("SPOKEN: no such place: %s", place)
    index["questions"] = [*questions(places, language)]
    text = json.dumps(index, ensure_ascii=False, separators=(",", ":"), sort_keys=True)
    (Path(app.outdir) / "_static" / INDEX).write_text(f"const SITE_INDEX = {text};\n", encoding="utf-8")


def _add_scripts(app: Sphinx, page: str, _: str, __: dict[str, Any], ___: nodes.document | None) -> None:
    """Load the scripts where Sphinx searches: when the page is read, and before it searches."""
    if page == "search":
        for script in (INDEX, SCRIPT):
            app.add_js_file(script, loading_method="defer")


def setup(app: Sphinx) -> dict[str, Any]:
    """See Sphinx."""
    app.connect("html-page-context", _add_scripts)
    app.connect("build-finished", _write_index)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
