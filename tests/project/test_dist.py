"""``make dist``: the wheel of a release, and the list of everything that it is installed with."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest
from support.paths import ROOT

pytestmark = pytest.mark.integration
PINNED = re.compile(r"^([A-Za-z0-9_.-]+)==([^ ;\\]+)", re.MULTILINE)


@pytest.mark.long
def test_a_release_has_a_wheel_and_a_list_of_all_that_comes_with_it(tmp_path: Path) -> None:
    # A copy: building leaves files beside the sources.
    tree = tmp_path / "tree"
    shutil.copytree(ROOT, tree, ignore=shutil.ignore_patterns(".*", "tests", "__pycache__", "build", "dist"))
    ready = Path(sys.prefix) / ".ready"
    subprocess.run(
        ["make", "--assume-old", str(ready), "dist", f"VENV={sys.prefix}", "DIST=out"],
        cwd=tree, check=True, capture_output=True, timeout=100,
    )  # fmt: skip
    [wheel] = (tree / "out").glob("*.whl")
    [listed] = (tree / "out").glob("*.cdx.json")
    assert listed.stem.removesuffix(".cdx") == "-".join(wheel.name.split("-")[:2])
    names = zipfile.ZipFile(wheel).namelist()
    assert {name.split("/")[0] for name in names if "dist-info" not in name} >= {
        "daqsvc",
        "drivers",
        "sim_hw",
    }
    bill = json.loads(listed.read_text("utf-8"))
    assert bill["bomFormat"] == "CycloneDX"
    there = {(part["name"], part["version"]) for part in bill["components"]}
    pinned = {
        (name, version) for name, version in PINNED.findall((ROOT / "requirements.lock").read_text("utf-8"))
    }
    assert there == pinned
    assert all(part["externalReferences"][0]["hashes"] for part in bill["components"])


def test_what_builds_the_wheel_is_pinned_with_hashes() -> None:
    text = (ROOT / "requirements-build.lock").read_text("utf-8")
    assert PINNED.findall(text) == [("setuptools", PINNED.search(text)[2])]
    assert "--hash=sha256:" in text
    readme = (ROOT / "README.md").read_text("utf-8")
    assert "pip install --require-hashes -r requirements.lock -r requirements-build.lock\n" in readme
    assert "pip install --no-deps --no-build-isolation ." in readme
