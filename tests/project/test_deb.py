"""``make deb``: the Debian package, and what of the libraries there is for other processors."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from support.paths import ROOT

pytestmark = [pytest.mark.integration, pytest.mark.long, pytest.mark.sources, pytest.mark.timeout(600)]

LOCK = ROOT / "requirements-service.lock"
NOT_FOR_A_SERVICE = {"matplotlib", "pyarrow", "amqtt", "aiomqtt", "rich", "pytest", "hypothesis"}
WITHOUT_WHEELS = {"cobs"}
"""Built where it is installed; without a compiler it does without its own."""


@pytest.fixture(scope="module")
def package(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The package, built of a copy of the tree; its files are unpacked beside it."""
    if shutil.which("dh") is None or not Path("/usr/bin/python3.11").exists():
        pytest.skip("a Debian package is built with debhelper and Debian's python3.11")
    tree = tmp_path_factory.mktemp("deb") / "tree"
    shutil.copytree(ROOT, tree, ignore=shutil.ignore_patterns(".*", "tests", "__pycache__", "build", "dist"))
    ready = Path(sys.prefix) / ".ready"
    built = subprocess.run(
        ["make", "--assume-old", str(ready), "deb", f"VENV={sys.prefix}", "DIST=out"],
        cwd=tree, check=False, capture_output=True, text=True, timeout=560,
    )  # fmt: skip
    assert built.returncode == 0, built.stdout + built.stderr
    [deb] = (tree / "out").glob("daqsvc_*.deb")
    subprocess.run(["dpkg-deb", "--extract", deb, tree / "root"], check=True, timeout=100)
    return deb


def test_it_holds_the_service_and_no_more(package: Path) -> None:
    root = package.parent.parent / "root"
    site = root / "usr/lib/daqsvc/lib/python3.11/site-packages"
    libraries = {path.name.split("-")[0].lower() for path in site.glob("*.dist-info")}
    names = re.findall(r"^([\w.-]+)==", LOCK.read_text("utf-8"), re.MULTILINE)
    pinned = {name.replace("-", "_").lower() for name in names}
    assert libraries == pinned | {"daqsvc"}
    assert not libraries & NOT_FOR_A_SERVICE
    assert {p.name for p in (root / "usr/lib/daqsvc/bin").iterdir() if not p.name.startswith("python")} == {
        "daqsvc",
        "daqsvc-sim",
    }
    assert (root / "usr/bin/daqsvc").readlink() == Path("../lib/daqsvc/bin/daqsvc")
    examples = {p.name for p in (root / "usr/share/doc/daqsvc/examples/machines").iterdir()}
    assert examples == {p.name for p in (ROOT / "config/machines").iterdir()}
    # What was compiled when it was built is what runs: the service cannot write there.
    assert len(list(site.glob("daqsvc/__pycache__/*.pyc"))) == len(list(site.glob("daqsvc/*.py")))


def test_nothing_in_it_names_the_place_where_it_was_built(package: Path) -> None:
    tree = package.parent.parent
    found = subprocess.run(
        ["grep", "--recursive", "--files-with-matches", "--binary-files=text", str(tree), tree / "root"],
        check=False, capture_output=True, text=True, timeout=100,
    )  # fmt: skip
    assert found.stdout == ""


def test_every_library_has_a_wheel_for_aarch64(tmp_path: Path) -> None:
    platforms = ["manylinux2014_aarch64", "manylinux_2_17_aarch64", "manylinux_2_28_aarch64"]
    listed = subprocess.run(
        [sys.executable, "-m", "pip", "install", "--dry-run", "--quiet", "--disable-pip-version-check",
         "--no-deps", "--target", tmp_path, *(f"--platform={name}" for name in platforms),
         "--python-version=3.11", "--implementation=cp", "--abi=cp311", "--abi=abi3", "--abi=none",
         "--only-binary=:all:", *(f"--no-binary={name}" for name in WITHOUT_WHEELS),
         "--require-hashes", "--requirement", LOCK, "--report", tmp_path / "report.json"],
        check=False, capture_output=True, text=True, timeout=200,
    )  # fmt: skip
    if "connection" in listed.stderr.lower() or "timed out" in listed.stderr:
        pytest.skip("PyPI cannot be reached")
    assert listed.returncode == 0, listed.stderr
