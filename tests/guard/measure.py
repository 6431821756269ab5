"""Figures of the source tree: its size, circles of imports, names that occur twice. ``make measure`` prints
them.

How each is counted stands beside it, so that two trees are measured alike. Nothing is imported: all is read
off the syntax of the files.
"""

# ruff: noqa: T201 - printing is what it is for

from __future__ import annotations

import ast
import re
import sys
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Literal, TypeAlias

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

ROOT = Path(__file__).parents[2]
PACKAGES = ("daqsvc", "drivers", "sim_hw")
DETECTORS = (
    "rotor-bank",
    "rotor_bank",
    "rotor-synchronous",
    "rotor_synchronous",
    "bearing",
    "levels",
    "trends",
)
DETECTOR_ROOMS = ("daqsvc/rotor/", "daqsvc/bearing/", "daqsvc/diagnosis/", "daqsvc/detectors/")
"""What a detector may be named in, today and by the picture of the house."""
DRIVERS = ("can", "modbus", "serial", "replay")
SAMPLE_TYPES = (
    *(
        "Decoded",
        "StreamFrames",
        "Frames",
        "Found",
        "ReceivedBytes",
        "Sorted",
        "Placement",
        "Placed",
        "Chunk",
    ),
    *("DecodedFrames", "DecodedBatch", "SampleBlock", "Window"),
)
SETTING = "on_delay_s"
Which: TypeAlias = Literal["run", "types", "all"]
"""Imports that count: at module level at run time; also for the type checker; also within functions."""


def sources(root: Path = ROOT) -> dict[str, str]:
    """Texts of the modules, by path."""
    return {
        str(path.relative_to(root)): path.read_text(encoding="utf-8")
        for package in PACKAGES
        for path in sorted((root / package).rglob("*.py"))
    }


def modules(texts: Mapping[str, str]) -> dict[str, ast.Module]:
    """Syntax trees, by the name that a module is imported by."""
    return {
        path.removesuffix(".py").replace("/", ".").removesuffix(".__init__"): ast.parse(text)
        for path, text in texts.items()
    }


def imports(trees: Mapping[str, ast.Module], packages: frozenset[str], which: Which) -> dict[str, set[str]]:
    """Which module imports which.

    An import of a package is one of its ``__init__``; that of a submodule is not, although the interpreter
    runs the ``__init__`` first.
    """
    found: dict[str, set[str]] = {}
    for name, tree in trees.items():
        mine: set[str] = set()
        package = name if name in packages else name.rpartition(".")[0]
        statements = ast.walk(tree) if which == "all" else _top_level(tree.body, typing=which == "types")
        for statement in statements:
            if isinstance(statement, ast.Import):
                mine.update(alias.name for alias in statement.names)
            elif isinstance(statement, ast.ImportFrom):
                base = statement.module or ""
                if statement.level:
                    above = package.split(".")[: len(package.split(".")) - statement.level + 1]
                    base = ".".join([*above, *([base] if base else [])])
                for alias in statement.names:
                    inner = f"{base}.{alias.name}"
                    mine.add(inner if inner in trees else base)
        found[name] = (mine & trees.keys()) - {name}
    return found


def _top_level(body: list[ast.stmt], *, typing: bool) -> Iterator[ast.stmt]:
    for statement in body:
        if isinstance(statement, ast.If):
            if typing or "TYPE_CHECKING" not in ast.dump(statement.test):
                yield from _top_level(statement.body, typing=typing)
            yield from _top_level(statement.orelse, typing=typing)
        elif isinstance(statement, ast.Try | ast.With):
            yield from _top_level(statement.body, typing=typing)
        else:
            yield statement


def circles(graph: Mapping[str, set[str]]) -> list[list[str]]:
    """Strongly connected sets of more than one module, the largest first (Tarjan 1972)."""
    number: dict[str, int] = {}
    low: dict[str, int] = {}
    stack: list[str] = []
    found: list[list[str]] = []

    def visit(name: str) -> None:
        number[name] = low[name] = len(number)
        stack.append(name)
        for other in sorted(graph[name]):
            if other not in number:
                visit(other)
                low[name] = min(low[name], low[other])
            elif other in stack:
                low[name] = min(low[name], number[other])
        if low[name] == number[name]:
            together = stack[stack.index(name) :]
            del stack[stack.index(name) :]
            if len(together) > 1:
                found.append(sorted(together))

    limit = sys.getrecursionlimit()
    sys.setrecursionlimit(max(limit, 10_000))
    for name in sorted(graph):
        if name not in number:
            visit(name)
    sys.setrecursionlimit(limit)
    return sorted(found, key=lambda one: (-len(one), one))


def repeated_classes(trees: Mapping[str, ast.Module]) -> dict[str, list[str]]:
    """Names that classes of several modules have, with these modules."""
    places: dict[str, list[str]] = {}
    for module, tree in trees.items():
        for node in ast.walk(tree):
            if isinstance(node, ast.ClassDef):
                places.setdefault(node.name, []).append(module)
    return {name: where for name, where in sorted(places.items()) if len(where) > 1}


def functions(trees: Mapping[str, ast.Module], name: str) -> list[str]:
    """Modules that define a function or method of that name, once for each definition."""
    return [
        module
        for module, tree in trees.items()
        for node in ast.walk(tree)
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef) and node.name == name
    ]


def naming(trees: Mapping[str, ast.Module], words: tuple[str, ...]) -> Counter[str]:
    """Modules in which a word is a string, or a key of the pipeline's settings (``pipeline.levels``)."""
    found: Counter[str] = Counter()
    for module, tree in trees.items():
        for node in ast.walk(tree):
            match node:
                case ast.Constant(value=str(text)) if text in words:
                    found[module] += 1
                case ast.Attribute(
                    attr=text, value=ast.Attribute(attr="pipeline") | ast.Name(id="pipeline")
                ) if text in words:
                    found[module] += 1
    return found


def compared(trees: Mapping[str, ast.Module], words: tuple[str, ...]) -> Counter[str]:
    """Modules in which one of these words is compared with something, is in a set for it, or is matched."""
    found: Counter[str] = Counter()
    for module, tree in trees.items():
        for node in ast.walk(tree):
            if isinstance(node, ast.Compare | ast.match_case):
                inside = ast.walk(node.pattern) if isinstance(node, ast.match_case) else ast.walk(node)
                found[module] += any(isinstance(one, ast.Constant) and one.value in words for one in inside)
    return +found


def fields(trees: Mapping[str, ast.Module], name: str) -> list[str]:
    """Classes that have an annotated field of that name."""
    return [
        f"{module}.{node.name}"
        for module, tree in trees.items()
        for node in ast.walk(tree)
        if isinstance(node, ast.ClassDef)
        for statement in node.body
        if isinstance(statement, ast.AnnAssign)
        and isinstance(statement.target, ast.Name)
        and statement.target.id == name
    ]


def main() -> int:
    """Print the table."""
    texts = sources()
    trees = modules(texts)
    packages = frozenset(
        path.removesuffix("/__init__.py").replace("/", ".") for path in texts if path.endswith("__init__.py")
    )
    classes = repeated_classes(trees)
    parts = [
        f"{package} {sum(len(t.splitlines()) for p, t in texts.items() if p.startswith(f'{package}/')):,}"
        for package in PACKAGES
    ]
    lines = sum(len(text.splitlines()) for text in texts.values())
    filled = sum(1 for text in texts.values() for line in text.splitlines() if line.strip())
    print(f"lines: {lines:,} in {len(texts)} modules ({', '.join(parts)})")
    print("    all lines of all .py files, blank ones, comments and docstrings too; __init__.py are modules")
    print(
        f"    without blank lines: {filled:,}; modules that hold more than a docstring: "
        f"{sum(len(tree.body) > 1 for tree in trees.values())}"
    )
    kinds: tuple[tuple[Which, str], ...] = (
        ("run", "at import time"),
        ("types", "those for the type checker included"),
        ("all", "those within functions included, too"),
    )
    for which, what in kinds:
        found = circles(imports(trees, packages, which))
        print(f"circles of imports, {what}: {len(found)}")
        for together in found:
            print(f"    {', '.join(together)}")
    print("    strongly connected sets of more than one module; the first two at module level only")
    print(f"class names that occur more than once: {len(classes)}")
    for name, where in classes.items():
        print(f"    {name}: {', '.join(where)}")
    take = functions(trees, "take")
    print(f"definitions of take: {len(take)} (functions and methods of exactly this name)")
    print(f"    {', '.join(take)}")
    named = naming(trees, DETECTORS)
    outside = {
        module: count
        for module, count in named.items()
        if not f"{module.replace('.', '/')}/".startswith(DETECTOR_ROOMS)
    }
    print(
        f"modules that name a kind of detector: {len(named)}, "
        f"outside {', '.join(DETECTOR_ROOMS)}: {len(outside)}"
    )
    print(f"    {', '.join(sorted(outside))}")
    print(f"    {', '.join(DETECTORS)}: as a whole string, or as a key of pipeline")
    for words, what in ((DETECTORS, "detector"), (DRIVERS, "driver")):
        branching = compared(trees, words)
        print(f"modules that branch on a kind of {what}: {len(branching)}: {', '.join(sorted(branching))}")
    print("    comparisons (==, in) and match cases with one of the words as a string")
    declared = fields(trees, SETTING)
    mentioned = [path for path, text in texts.items() if re.search(rf"\b{SETTING}\b", text)]
    delays = [path for path, text in texts.items() if re.search(r"\bon_delay(_s|_ns)?\b", text)]
    print(f"classes with a field {SETTING}: {len(declared)}: {', '.join(declared)}")
    print(
        f"    modules with the word {SETTING}: {len(mentioned)}; "
        f"with on_delay, on_delay_s or on_delay_ns: {len(delays)}:"
    )
    print(f"    {', '.join(delays)}")
    there = {
        name: where
        for name in SAMPLE_TYPES
        if (
            where := [
                m for m, t in trees.items() for n in t.body if isinstance(n, ast.ClassDef) and n.name == name
            ]
        )
    }
    print(
        f"types that carry samples from bus to detector: {len(there)} of {len(SAMPLE_TYPES)}: "
        f"{', '.join(there)}"
    )
    print("    classes of these names; look by hand for new ones")
    for word in (
        "load_machine_file",
        "parse_machine_file",
        "machine_file_model().model_validate",
        "isinstance(counters",
    ):
        users = [path for path, text in texts.items() if word in text]
        print(f"modules with {word}: {len(users)}: {', '.join(users)}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
