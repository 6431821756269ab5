"""A Sphinx extension: pages written for a forge become pages of the site, unchanged.

- A link to a file of the repository leads to a copy of it, one to a folder to its README.md; where there is
  none, the words stay, without the link. A link that leads nowhere is left as it is: the build fails at it.
  So it does at a link in raw HTML that leads nowhere, and at a reference that is defined nowhere.
- index.md, and README.md of a folder, list pages; these lists are the contents at the side of the site.
"""

from __future__ import annotations

import posixpath
import re
from html import unescape
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import unquote

from docutils import nodes
from sphinx.util import logging

if TYPE_CHECKING:
    from sphinx.application import Sphinx

ROOT = Path(__file__).parents[1]
_log = logging.getLogger(__name__)
STUBS = {
    "README.md": "docs/readme.md",
    "CONTRIBUTING.md": "docs/contributing.md",
    "CHANGELOG.md": "docs/changelog.md",
}
"""Pages of the site that include a file from elsewhere in the repository, by that file."""
FENCE = re.compile(r"^ *(`{3,}).*?^ *\1 *$", re.MULTILINE | re.DOTALL)
LINK = re.compile(r"(?<!!)\[((?:[^\[\]]|!?\[[^\[\]]*\]\([^()]*\))*)\]\(([^()\s]+)\)")
IMAGE = re.compile(r"!\[([^\[\]]*)\]\(([^()\s]+)\)")
ENTRY = re.compile(r"^(?:- \[(?P<title>[^\[\]]+)\]|\| \[[^\[\]]+\])\((?P<page>[^()\s#]+\.md)\)", re.MULTILINE)
SECTION = re.compile(r"^(?=## )", re.MULTILINE)
ANCHOR = re.compile(r'<a id="([^"]+)">')
REFERENCE = re.compile(r"\[[^\[\]]+\]\[[^\[\]]*\]")
RAW_LINK = re.compile(
    r"""\b(?:href|src)\s*=\s*["'](?![a-z]+:|//)([^"'#?]*)(?:\?[^"'#]*)?(?:#([^"']*))?["']"""
)
IDS = re.compile(r'\b(?:id|name)="([^"]+)"')
EXTERNAL = re.compile(r"^(?:[a-z]+:|#)")


def site_text(text: str, file: str, page: str) -> str:
    """What the site has of a Markdown file.

    Args:
        text: of the file.
        file: where it lies in the repository.
        page: the page that it becomes, or is included in.
    """

    def link(match: re.Match[str]) -> str:
        words, target = match.groups()
        if EXTERNAL.match(target):
            return match[0]
        path, hash_sign, anchor = target.partition("#")
        there = posixpath.normpath(posixpath.join(posixpath.dirname(file), path))
        if (ROOT / there).is_dir():
            if not (ROOT / there / "README.md").exists() or not there.startswith("docs/"):
                return words
            there = f"{there}/README.md"
        there = STUBS.get(there, there)
        return f"[{words}]({posixpath.relpath(there, posixpath.dirname(page))}{hash_sign}{anchor})"

    def image(match: re.Match[str]) -> str:
        there = posixpath.normpath(posixpath.join(posixpath.dirname(file), match[2]))
        return f"![{match[1]}]({posixpath.relpath(there, posixpath.dirname(page))})"

    def prose(part: str) -> str:
        return LINK.sub(link, IMAGE.sub(image, part))

    parts, end = [], 0
    for fence in FENCE.finditer(text):
        parts += [prose(text[end : fence.start()]), fence[0]]
        end = fence.end()
    return "".join([*parts, prose(text[end:])])


def contents(text: str) -> str:
    """The table of contents, hidden, of a page that lists pages: for each section its own."""
    made = []
    for section in SECTION.split(text):
        found = [(one["title"], one["page"]) for one in ENTRY.finditer(section)]
        entries = [f"{title} <{page}>" if title else page for title, page in found]
        if entries:
            heading = section.partition("\n")[0]
            caption = f":caption: {heading.lstrip('# ')}\n" if heading.startswith("## ") else ""
            made.append("\n".join(["```{toctree}", f":hidden:\n{caption}", *entries, "```\n"]))
    return "\n".join(["", *made])


def _read(_: Sphinx, name: str, source: list[str]) -> None:
    page = f"docs/{name}.md"
    listed = contents(source[0]) if posixpath.basename(page) in {"index.md", "README.md"} else ""
    source[0] = site_text(source[0], page, page) + listed


def _read_included(_: Sphinx, path: Path, parent: str, source: list[str]) -> None:
    file = posixpath.normpath(posixpath.join("docs", path.as_posix()))
    source[0] = site_text(source[0], file, f"docs/{parent}.md")


def _note_anchors(app: Sphinx, doctree: nodes.document) -> None:
    """Links may lead to anchors that a page has besides those of its headings."""
    anchors = [name for raw in doctree.findall(nodes.raw) for name in ANCHOR.findall(raw.astext())]
    slugs = app.env.metadata[app.env.docname].setdefault("myst_slugs", {})
    slugs.update({name: (0, name, "") for name in anchors})


def _find_undefined(app: Sphinx, doctree: nodes.document) -> None:
    """A reference in brackets that nothing defines stays in the text as it is written."""
    for text in doctree.findall(nodes.Text):
        if not isinstance(text.parent, nodes.literal | nodes.literal_block | nodes.raw | nodes.comment):
            for reference in REFERENCE.findall(text.astext()):
                _log.warning("undefined reference: %s", reference, location=app.env.docname)


def _find_dead_links(app: Sphinx, failure: Exception | None) -> None:
    """What raw HTML links to must be in the site; Sphinx sees only links of Markdown."""
    if failure is not None or app.builder.format != "html":
        return
    for name in sorted(app.env.found_docs):
        raw = "".join(one.astext() for one in app.env.get_doctree(name).findall(nodes.raw))
        page = Path(app.outdir) / f"{name}.html"
        for path, anchor in RAW_LINK.findall(raw):
            there = page.parent / unquote(unescape(path)) if path else page
            if not there.exists():
                _log.warning("a link in HTML leads nowhere: %s", path, location=name)
            elif anchor and unescape(anchor) not in IDS.findall(there.read_text("utf-8")):
                _log.warning("a link in HTML leads to no anchor: %s#%s", path, anchor, location=name)


def setup(app: Sphinx) -> dict[str, Any]:
    """See Sphinx."""
    app.connect("source-read", _read)
    app.connect("include-read", _read_included)
    app.connect("doctree-read", _note_anchors)
    app.connect("doctree-read", _find_undefined)
    app.connect("build-finished", _find_dead_links)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
