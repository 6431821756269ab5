"""The commands of the guides give each machine a store of its own."""

from __future__ import annotations

import subprocess
from typing import TYPE_CHECKING

import pytest
from support.guide_commands import shell_blocks

from daqsvc.cli import main

if TYPE_CHECKING:
    from pathlib import Path


@pytest.mark.parametrize("guide", ["install.md", "edge-box.md"])
def test_the_guides_give_a_machine_a_store_of_its_own(guide: str, tmp_path: Path) -> None:
    commands = [line for blocks in shell_blocks(guide).values() for block in blocks for line in block]
    [edit] = [line for line in commands if line.startswith("sed -i ")]
    machine = tmp_path / "pump.toml"
    assert main(["example", "laval-rig", "--out", f"{machine}"]) == 0
    subprocess.run(["/bin/sh", "-c", edit.replace("/etc/daqsvc/pump.toml", f"{machine}")], check=True)
    assert 'directory = "/var/lib/daqsvc/pump"' in machine.read_text()
