"""`daqsvc.settings` reads the tables of plugins, and names none of them."""

from __future__ import annotations

import ast
from importlib.metadata import entry_points
from typing import TYPE_CHECKING

import pytest
from support.paths import ROOT

from daqsvc.settings.registry import DETECTORS, DRIVERS, OUTPUTS, detector_tables

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path


def texts(file: Path) -> Iterator[str]:
    """The texts of a module, each as it stands and, of a path of keys, each key."""
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Constant) and isinstance(node.value, str):
            yield node.value
            yield from node.value.split(".")


@pytest.mark.sources
def test_no_driver_no_detector_and_no_output_is_named() -> None:
    keys = {point.name for group in (DRIVERS, DETECTORS, OUTPUTS) for point in entry_points(group=group)}
    names = keys | {plugin.detector for plugin in detector_tables().values() if plugin.detector}
    assert {"can", "rotor_bank", "rotor-bank", "mqtt"} <= names
    files = sorted((ROOT / "daqsvc" / "settings").glob("*.py"))
    assert len(files) > 20
    named = [(file.name, text) for file in files for text in texts(file) if text in names]
    assert not named
