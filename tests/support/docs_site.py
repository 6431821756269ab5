"""The site of the documentation, built from a copy of this tree."""

from __future__ import annotations

import shutil
import subprocess
from typing import TYPE_CHECKING

from support.made_once import made_once
from support.paths import ROOT

if TYPE_CHECKING:
    from pathlib import Path

    import pytest

_NOT_IN_IT = shutil.ignore_patterns(".*", "__pycache__", "*.egg-info", "build", "dist")


def copied_tree(folder: Path) -> Path:
    """What `make_docs` needs."""
    return shutil.copytree(ROOT, folder / "tree", ignore=_NOT_IN_IT)


def make_docs(tree: Path) -> subprocess.CompletedProcess[str]:
    """``make docs``, with the Sphinx that this tree has or sets up now."""
    command = ["make", "docs", f"DOCS_VENV={ROOT / '.venv-docs'}"]
    return subprocess.run(command, cwd=tree, check=False, capture_output=True, text=True, timeout=280)


def built_docs(factory: pytest.TempPathFactory) -> Path:
    """The folder of the site, built once for all tests of a run."""

    def build(folder: Path) -> Path:
        tree = copied_tree(folder)
        made = make_docs(tree)
        assert made.returncode == 0, made.stdout + made.stderr
        return tree / "build" / "docs" / "html"

    return made_once(factory, "docs-site", build)
