"""The commands of the guides give each machine a store of its own."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest

from daqsvc.cli import main

ROOT = Path(__file__).parents[2]


@pytest.mark.parametrize("guide", ["install.md", "edge-box.md"])
def test_the_guides_give_a_machine_a_store_of_its_own(guide: str, tmp_path: Path) -> None:
    lines = (ROOT / "docs" / guide).read_text().splitlines()
    [line] = [line for line in lines if line.startswith("sed -i ")]
    machine = tmp_path / "pump.toml"
    assert main(["example", "laval-rig", "--out", f"{machine}"]) == 0
    edit = line.partition("   #")[0].replace("/etc/daqsvc/pump.toml", f"{machine}")
    subprocess.run(["/bin/sh", "-c", edit], check=True)
    assert 'directory = "/var/lib/daqsvc/pump"' in machine.read_text()
