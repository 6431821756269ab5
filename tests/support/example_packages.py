"""The worked examples of the documentation, put where Python looks for packages."""

from __future__ import annotations

import importlib
import sys
import tomllib
from typing import TYPE_CHECKING

from support.paths import ROOT

from daqsvc.settings import registry

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    import pytest

DOCS = ROOT / "docs"
DRIVER = DOCS / "example_driver"
DETECTOR = DOCS / "example_detector"
OUTPUT = DOCS / "example_output"
MESSAGE_CODES = DOCS / "example_codes"


def installed(example: Path, site: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Have an example's package with the entry points that its project file states, as long as this runs."""
    project = tomllib.loads((example / "pyproject.toml").read_text())["project"]
    info = site / f"{project['name'].replace('-', '_')}-{project['version']}.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text(
        f"Metadata-Version: 2.1\nName: {project['name']}\nVersion: {project['version']}\n"
    )
    (info / "entry_points.txt").write_text(
        "".join(
            f"[{group}]\n" + "".join(f"{name} = {value}\n" for name, value in points.items())
            for group, points in project["entry-points"].items()
        )
    )
    with monkeypatch.context() as patch:
        patch.syspath_prepend(str(site))
        patch.syspath_prepend(str(example))
        importlib.invalidate_caches()
        registry.forget()
        yield
        for module in example.glob("*.py"):
            sys.modules.pop(module.stem, None)
    registry.forget()


def lines_of(example: Path) -> int:
    """Lines of an example's module that are not blank."""
    [module] = example.glob("*.py")
    return sum(bool(line.strip()) for line in module.read_text().splitlines())
