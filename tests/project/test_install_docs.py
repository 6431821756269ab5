"""The commands of the guides give each machine a store of its own."""

from __future__ import annotations

import subprocess
import tomllib
from typing import TYPE_CHECKING

import pytest
from support.guide_commands import shell_blocks
from support.paths import ROOT

from daqsvc.cli import main

if TYPE_CHECKING:
    from pathlib import Path


@pytest.mark.parametrize(
    ("guide", "example", "name"), [("install.md", "bearing", "fan"), ("edge-box.md", "laval-rig", "pump")]
)
def test_the_guides_give_a_machine_a_store_of_its_own(
    guide: str, example: str, name: str, tmp_path: Path
) -> None:
    commands = [line for blocks in shell_blocks(guide).values() for block in blocks for line in block]
    [edit] = [line for line in commands if line.startswith("sed -i ")]
    assert f"daqsvc example {example} --out /etc/daqsvc/{name}.toml" in commands
    machine = tmp_path / f"{name}.toml"
    assert main(["example", example, "--out", f"{machine}"]) == 0
    subprocess.run(["/bin/sh", "-c", edit.replace(f"/etc/daqsvc/{name}.toml", f"{machine}")], check=True)
    assert f'directory = "/var/lib/daqsvc/{name}"' in machine.read_text()


def test_a_box_has_its_first_machine_in_the_three_commands_that_both_guides_give() -> None:
    _, install, _ = shell_blocks("install.md")["The package"]
    assert len(install) == 3
    readme = [block for blocks in shell_blocks("README.md", ROOT).values() for block in blocks]
    assert ["make deb", *install] in readme


def test_a_clone_gets_daqsvc_on_the_path_as_the_guide_and_the_readme_state() -> None:
    [[setup, activate, _]] = shell_blocks("install.md")["From a clone"]
    assert (setup, activate) == ("make venv", ". .venv/bin/activate")
    readme = (ROOT / "README.md").read_text("utf-8")
    assert all(f"`{command}`" in readme for command in (setup, activate))
    # Nothing but the environment is set up, and there daqsvc is.
    command = [*setup.split(), "--dry-run", "--old-file=.venv/.ready"]
    made = subprocess.run(command, cwd=ROOT, check=True, capture_output=True, text=True)
    assert "Nothing to be done" in made.stdout
    daqsvc = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]["scripts"]["daqsvc"]
    assert daqsvc == "daqsvc.cli:main"
