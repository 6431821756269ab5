"""Every place that raises an error for users names its code, and every code is raised somewhere."""

from __future__ import annotations

import ast
from typing import TYPE_CHECKING

import pytest
from errors.test_codes import named
from support.paths import ROOT

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

CODE_AT = {
    "Finding": 4,
    "Problem": 6,
    "TomlTextError": 2,
    "UnreadableFileError": 2,
    "AssemblyError": 1,
    "PydanticCustomError": 2,
}
"""What users are shown, with the position of the code; of pydantic's, that of the context that has it."""
FILES = [
    file
    for package in ("daqsvc", "drivers")
    for file in sorted((ROOT / package).rglob("*.py"))
    if file.parent != ROOT / "daqsvc" / "errors"
]
EXEMPT = {
    ("daqsvc/rotor/calibration/file.py", "PydanticCustomError"): "put into the words of one AssemblyError",
}


def raised(tree: ast.AST) -> Iterator[tuple[ast.Call, str]]:
    """The calls that make what users are shown, with what they make."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id in CODE_AT:
            yield node, node.func.id


def code_of(call: ast.Call, kind: str) -> ast.expr | None:
    """The code that a call names."""
    place = CODE_AT[kind]
    given = {one.arg: one.value for one in call.keywords}
    value = given.get("code", call.args[place] if len(call.args) > place else None)
    if kind == "PydanticCustomError":
        if not isinstance(value, ast.Dict):
            return None
        keys = [key.value if isinstance(key, ast.Constant) else None for key in value.keys]
        value = value.values[keys.index("code")] if "code" in keys else None
    return None if isinstance(value, ast.Constant) else value


@pytest.mark.parametrize("file", FILES, ids=lambda file: str(file.relative_to(ROOT)))
def test_what_users_are_shown_has_a_code(file: Path) -> None:
    place = str(file.relative_to(ROOT))
    tree = ast.parse(file.read_text(encoding="utf-8"))
    without = [
        f"{place}:{call.lineno}: {kind}"
        for call, kind in raised(tree)
        if code_of(call, kind) is None and (place, kind) not in EXEMPT
    ]
    assert not without, "name a code of daqsvc.errors"


def test_every_code_is_raised_somewhere() -> None:
    used = {
        node.id
        for file in FILES
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8")))
        if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Load)
    }
    assert [f"{code} {name}" for code, name in named() if name not in used] == []
