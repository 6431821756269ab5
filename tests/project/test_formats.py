"""Every JSON that users and programs read or write is on the page of formats, and has a schema."""

from __future__ import annotations

import re

import pytest
from support.paths import ROOT

from daqsvc.audit import AuditLine
from daqsvc.publish.schemas import PAYLOADS, schema_files
from daqsvc.reference import formats, messages, verbs
from daqsvc.reference.typed import schema_of

pytestmark = pytest.mark.unit
ROOMS = ("daqsvc", "drivers", "sim_hw")


@pytest.mark.sources
def test_every_format_that_the_code_names_has_a_section_and_a_schema():
    sources = [file for room in ROOMS for file in (ROOT / room).rglob("*.py")]
    found = {
        name for file in sources for name in re.findall(r"daqsvc\.[a-z-]+/[0-9]+", file.read_text("utf-8"))
    }
    assert len(found) > 15
    assert found == formats.named_in_code()
    made = {**messages.pages(), **formats.pages()}
    files = {**schema_files(), **formats.schema_files()}
    for name in found:
        page = made["payloads.md" if name in PAYLOADS else "formats.md"]
        assert f"## `{name}`" in page, name
        assert f"{name.replace('/', '-')}.json" in files, name


def test_a_format_or_a_field_that_nothing_describes_is_a_gap(monkeypatch):
    known = {name: one for name, one in formats.FORMATS.items() if name != "daqsvc.trend/1"}
    monkeypatch.setattr(formats, "FORMATS", known)
    words = (AuditLine.__doc__ or "").replace("        wall_ns: ", "        other: ")
    monkeypatch.setattr(AuditLine, "__doc__", words)
    formats.schemas.cache_clear()
    found = "; ".join(formats.gaps())
    formats.schemas.cache_clear()
    assert "format daqsvc.trend/1 is described nowhere" in found
    assert "field AuditLine.wall_ns of daqsvc.audit/1 has no description" in found


def test_a_verb_whose_json_nothing_describes_is_a_gap(monkeypatch):
    known = {name: one for name, one in formats.FORMATS.items() if name != "daqsvc fleet"}
    monkeypatch.setattr(formats, "FORMATS", known)
    assert "daqsvc fleet --json prints what is described nowhere" in "; ".join(verbs.gaps())


def test_every_verb_with_json_names_its_format_on_the_page_of_verbs():
    rows = [row for row in verbs.pages()["verbs.md"].splitlines() if "`--json`" in row]
    assert len(rows) > 20
    assert [row for row in rows if not re.search(r"\((formats|payloads)\.md#daqsvc", row)] == []


def test_a_type_that_json_has_not_is_refused():
    with pytest.raises(TypeError, match="no type of JSON"):
        schema_of("name", ((set,),))
