"""The table of rules in the documentation names the tests that there are."""

from __future__ import annotations

import re

from support.paths import ROOT


def test_the_table_of_rules_names_the_tests() -> None:
    told = re.findall(r"^\| `(tck-id-[a-z-]+)`", (ROOT / "docs" / "sparkplug.md").read_text(), re.MULTILINE)
    files = sorted((ROOT / "tests" / "publish" / "sparkplug").glob("test_sparkplug*.py"))
    source = "".join(file.read_text() for file in files)
    tests = [name.replace("_", "-") for name in re.findall(r"async def test_(tck_id_\w+)\(", source)]
    assert sorted(told) == sorted(tests)
