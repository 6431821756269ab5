"""``make deb``: what is in the Debian package, and what of its libraries there is for other processors.

tests/hil/test_package.py installs it.
"""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from support.deb_package import packages
from support.made_once import made_once
from support.paths import ROOT

from daqsvc.page.documentation import PLACES

pytestmark = [
    *(pytest.mark.integration, pytest.mark.long, pytest.mark.first, pytest.mark.sources),
    pytest.mark.timeout(600),
]

LOCK = ROOT / "requirements-service.lock"
NOT_FOR_A_SERVICE = {"matplotlib", "pyarrow", "amqtt", "aiomqtt", "rich", "pytest", "hypothesis"}
WITHOUT_WHEELS = {"cobs"}
"""Built where it is installed; without a compiler it does without its own."""


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The files of the package."""
    if shutil.which("dh") is None or not Path("/usr/bin/python3.11").exists():
        pytest.skip("a Debian package is built with debhelper and Debian's python3.11")

    def unpack(folder: Path) -> Path:
        subprocess.run(["dpkg-deb", "--extract", packages()[0], folder], check=True, timeout=100)
        return folder

    return made_once(tmp_path_factory, "deb", unpack)


def test_it_holds_the_service_and_no_more(root: Path) -> None:
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
    for kind in ("machines", "prometheus"):
        examples = {p.name for p in (root / "usr/share/doc/daqsvc/examples" / kind).iterdir()}
        assert examples == {p.name for p in (ROOT / "config" / kind).iterdir()}
    # What was compiled when it was built is what runs: the service cannot write there.
    assert len(list(site.glob("daqsvc/__pycache__/*.pyc"))) == len(list(site.glob("daqsvc/*.py")))


def test_it_holds_the_site_of_the_documentation_where_the_page_looks_for_it(root: Path) -> None:
    site = root / PLACES[1].relative_to("/")
    assert (site / "index.html").read_text("utf-8").startswith("<!doctype html>")
    pages = {page.relative_to(ROOT / "docs").with_suffix("") for page in (ROOT / "docs").rglob("*.md")}
    assert {page.relative_to(site).with_suffix("") for page in site.rglob("*.html")} >= pages
    assert "keyphasor" in (site / "searchindex.js").read_text("utf-8")
    assert not list(site.rglob("*.gz")), "a browser opens none"
    # A terminal shows the pages, too; not those that only include a file from elsewhere.
    texts = {page.name for page in (root / "usr/share/doc/daqsvc").glob("*.md")}
    assert texts == {page.name for page in (ROOT / "docs").glob("*.md")} - {
        "readme.md",
        "contributing.md",
        "changelog.md",
    }


def test_nothing_in_it_names_the_place_where_it_was_built(root: Path) -> None:
    tree = packages()[0].parent.parent
    found = subprocess.run(
        ["grep", "--recursive", "--files-with-matches", "--binary-files=text", str(tree), root],
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
