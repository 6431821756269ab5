"""Every place that raises an error for users names its code, and every code is raised somewhere."""

from __future__ import annotations

import ast
import re
from typing import TYPE_CHECKING

import pytest
from errors.test_codes import named
from support.paths import ROOT

from daqsvc.errors.table import CODES

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
    "complain": 2,
    "_complain": 2,
    "RecordingError": 1,
    "NamesError": 1,
    "ExportUsageError": 1,
}
"""What users are shown, with the position of the code; of pydantic's, that of the context that has it."""
FILES = [
    file
    for package in ("daqsvc", "drivers", "sim_hw")
    for file in sorted((ROOT / package).rglob("*.py"))
    if file.parent != ROOT / "daqsvc" / "errors"
]
EXEMPT = {
    ("daqsvc/rotor/calibration/file.py", "PydanticCustomError"): "put into the words of one AssemblyError",
}
NO_FAULT = {
    "daqsvc/cli.py": {"_check", "load", "main"},  # what they print has its codes
    "daqsvc/commands/account.py": {"_password"},  # asks again
    "daqsvc/commands/analyze_fleet.py": {"_say"},  # progress
    "daqsvc/commands/calibrate.py": {"_with_notes_printed"},  # warnings, and all goes on
    "daqsvc/commands/export.py": {"_export"},  # likewise
    "daqsvc/commands/complaint.py": {"complain"},
    "daqsvc/commands/detectability.py": {"_of_values"},  # has its code
    "daqsvc/commands/record.py": {"_tell"},  # progress
    "daqsvc/commands/reload.py": {"run"},  # lines of the service, which have their codes
    "daqsvc/commands/sniff.py": {"_tell"},  # progress
    "daqsvc/commands/store_argument.py": {"_of_file"},  # goes on with what was said before
    "daqsvc/kernel_cache.py": {"say_compiling"},  # progress
    "daqsvc/reference/__main__.py": {"main"},  # what a developer is told who makes the pages
    "sim_hw/bus_socket.py": {"run_hub"},  # progress
    "sim_hw/demo/command.py": {"_say"},  # warnings, and all goes on
    "sim_hw/reproduce/command.py": {"_note"},  # progress
    "sim_hw/sim_command.py": {"_say"},  # progress, and problems of a machine file, which have their codes
}
"""Functions that print to stderr what ends no command."""
WRITES_TO_STDERR = {"sys.stderr.write", "warnings.warn", "traceback.print_exc", "traceback.print_exception"}
SHOWS = re.compile(rf"\b(?:{'|'.join(CODE_AT)})\b")
PRINTS = re.compile(r"stderr|SystemExit|\bexit\b|\bwarn\b|\bprint_exc")
"""Words without which nothing is found in a text: to parse the others would take seconds."""


def raised(tree: ast.AST) -> Iterator[tuple[ast.Call, str]]:
    """The calls that make what users are shown, with what they make."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name | ast.Attribute):
            made = node.func.id if isinstance(node.func, ast.Name) else node.func.attr
            if made in CODE_AT:
                yield node, made


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


def without_code(text: str) -> list[tuple[int, str]]:
    """What users are shown without a code: the line, and what is made there."""
    if not SHOWS.search(text):
        return []
    return [(call.lineno, kind) for call, kind in raised(ast.parse(text)) if code_of(call, kind) is None]


@pytest.mark.parametrize("file", FILES, ids=lambda file: str(file.relative_to(ROOT)))
def test_what_users_are_shown_has_a_code(file: Path) -> None:
    place = str(file.relative_to(ROOT))
    found = without_code(file.read_text(encoding="utf-8"))
    without = [f"{place}:{line}: {kind}" for line, kind in found if (place, kind) not in EXEMPT]
    assert not without, "name a code of daqsvc.errors"


@pytest.mark.parametrize(
    ("line", "is_found"),
    [
        ("raise RecordingError('it is damaged')", True),
        ("raise recording.RecordingError('it is damaged', None)", True),
        ("complain('daqsvc status', error, None)", True),
        ("raise PydanticCustomError('odd', 'it is odd', {'remedy': 'mend it'})", True),
        ("yield problems.Finding(('box',), 'is odd', 'mend it', 'x')", True),
        ("raise RecordingError('it is damaged', DAMAGED)", False),
        ("raise RecordingError('it is damaged', code=DAMAGED)", False),
        ("raise PydanticCustomError('odd', 'it is odd', {'code': BAD_TEXT})", False),
        ("raise ValueError('for whoever has written the call')", False),
    ],
)
def test_an_error_without_a_code_is_found(line: str, *, is_found: bool) -> None:
    assert bool(without_code(line)) is is_found


def prints_to_stderr(node: ast.AST) -> bool:
    """Whether a call writes to stderr by itself."""
    if not isinstance(node, ast.Call):
        return False
    if ast.unparse(node.func) == "print":
        return any(one.arg == "file" and ast.unparse(one.value) == "sys.stderr" for one in node.keywords)
    if ast.unparse(node.func) in {"SystemExit", "sys.exit"}:
        # A text is printed, a number is the exit code.
        return any(
            isinstance(one, ast.JoinedStr) or isinstance(getattr(one, "value", 0), str) for one in node.args
        )
    return ast.unparse(node.func) in WRITES_TO_STDERR


def printing(text: str) -> set[str]:
    """The functions that write to stderr by themselves; ``<module>`` is what no function does."""
    if not PRINTS.search(text):
        return set()
    tree = ast.parse(text)
    functions = [one for one in ast.walk(tree) if isinstance(one, ast.FunctionDef | ast.AsyncFunctionDef)]
    within = {node: one.name for one in functions for node in ast.walk(one)}
    return {within.get(node, "<module>") for node in ast.walk(tree) if prints_to_stderr(node)}


@pytest.mark.parametrize("file", FILES, ids=lambda file: str(file.relative_to(ROOT)))
def test_what_goes_to_stderr_has_a_code(file: Path) -> None:
    """A command says what went wrong with `complain`, which asks for the code."""
    place = str(file.relative_to(ROOT))
    assert printing(file.read_text(encoding="utf-8")) == NO_FAULT.get(place, set())


@pytest.mark.parametrize(
    ("line", "is_found"),
    [
        ("print('away', file=sys.stderr)", True),
        ("sys.stderr.write('away')", True),
        ("raise SystemExit('away')", True),
        ("sys.exit(f'{error}')", True),
        ("warnings.warn('away')", True),
        ("traceback.print_exc()", True),
        ("print('there')", False),
        ("sys.exit(main())", False),
        ("raise SystemExit(EXIT_USAGE)", False),
    ],
)
def test_what_goes_to_stderr_is_found(line: str, *, is_found: bool) -> None:
    assert printing(line) == ({"<module>"} if is_found else set())
    assert printing(f"def run():\n    {line}") == ({"run"} if is_found else set())


def loaded(text: str, wanted: set[str]) -> set[str]:
    """Which of the wanted names a text uses, other than to import them."""
    if wanted.isdisjoint(re.findall(r"\w+", text)):
        return set()
    nodes = ast.walk(ast.parse(text))
    return wanted & {one.id for one in nodes if isinstance(one, ast.Name) and isinstance(one.ctx, ast.Load)}


def test_every_code_is_raised_somewhere() -> None:
    # The ingester of PostgreSQL stands alone: it writes the codes as they are.
    used = {f"{code}" for code in codes_of_ingester()}
    wanted = {either for one in named() for either in one}
    for file in FILES:
        used |= loaded(file.read_text(encoding="utf-8"), wanted - used)
    assert [f"{code} {name}" for code, name in named() if not {code, name} & used] == []


def test_a_code_that_is_imported_or_in_a_text_only_is_not_raised() -> None:
    text = "from daqsvc.errors.buses import LINK_LOST, OTHER\n# B29\nsay('OTHER', code=LINK_LOST)\nOLD = 1\n"
    assert loaded(text, {"LINK_LOST", "OTHER", "B29", "OLD", "LINK"}) == {"LINK_LOST"}


def codes_of_ingester() -> list[str]:
    text = (ROOT / "config" / "postgresql" / "ingest.py").read_text(encoding="utf-8")
    return re.findall(r"\b[A-Z][0-9]{2}(?=[\]\"])", text)


def test_the_ingester_of_postgresql_has_codes_that_there_are() -> None:
    codes = codes_of_ingester()
    assert len(codes) >= 6
    assert {*codes} <= CODES.keys()
