"""``make deb``: the Debian package, and what of the libraries there is for other processors."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from support.made_once import made_once
from support.paths import ROOT

import daqsvc

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
    return made_once(tmp_path_factory, "deb", build)


def build(folder: Path) -> Path:
    """The package of a copy of the tree, in a folder; its path."""
    tree = folder / "tree"
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
    for kind in ("machines", "prometheus"):
        examples = {p.name for p in (root / "usr/share/doc/daqsvc/examples" / kind).iterdir()}
        assert examples == {p.name for p in (ROOT / "config" / kind).iterdir()}
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


IN_A_BOX_OF_ITS_OWN = """
set -e
mount -t tmpfs -o size=3g tmpfs "$1" 2>/dev/null || exit 77
mkdir "$1/upper" "$1/work" "$1/root"
mount -t overlay overlay -o "lowerdir=/,upperdir=$1/upper,workdir=$1/work" "$1/root" 2>/dev/null || exit 77
mount -t proc proc "$1/root/proc"
mkdir -p "$1/root/debs" && cp "$2" "$1/root/debs/old.deb" && cp "$3" "$1/root/debs/new.deb"
exec env --ignore-environment PATH=/usr/sbin:/usr/bin:/sbin:/bin HOME=/root DEBIAN_FRONTEND=noninteractive \\
    chroot "$1/root" sh -ec '
        get() { apt-get -o APT::Sandbox::User=root -qq -y --no-install-recommends "$@" 2>&1; }
        cd /debs
        get install ./old.deb
        echo "first: $(dpkg-query -W -f "\\${Version}" daqsvc), $(daqsvc --version), $(id -un daqsvc)"
        daqsvc example laval-rig --out /etc/daqsvc/pump.toml
        install -d /var/lib/daqsvc/pump /var/cache/daqsvc/kernels
        daqsvc check /etc/daqsvc/pump.toml >/dev/null
        systemd-analyze verify /lib/systemd/system/daqsvc@.service
        get install ./new.deb
        echo "upgraded: $(dpkg-query -W -f "\\${Version}" daqsvc), $(ls /etc/daqsvc /var/lib/daqsvc | xargs)"
        get install --allow-downgrades ./old.deb
        echo "gone back: $(dpkg-query -W -f "\\${Version}" daqsvc)"
        get remove daqsvc
        cd /
        left() { ls -d "$@" etc/daqsvc/* var/lib/daqsvc/* 2>/dev/null | xargs; }
        echo "removed: $(left usr/lib/daqsvc usr/bin/daqsvc)"
        get purge daqsvc
        echo "purged: $(left var/cache/daqsvc)"
    '
"""


def test_it_is_installed_upgraded_taken_back_and_removed(package: Path, tmp_path: Path) -> None:
    """By apt, on this machine's files under a layer that is thrown away."""
    if os.geteuid() != 0:
        pytest.skip("only root may mount the layer that keeps this machine clean")
    old = package.name.split("_")[1]
    subprocess.run(["dpkg-deb", "--raw-extract", package, tmp_path / "new"], check=True, timeout=100)
    control = tmp_path / "new" / "DEBIAN" / "control"
    control.write_text(control.read_text().replace(f"Version: {old}\n", f"Version: {old}.1\n"))
    subprocess.run(
        ["dpkg-deb", "-Znone", "--build", tmp_path / "new", tmp_path / "new.deb"], check=True, timeout=100
    )
    (tmp_path / "box").mkdir()
    done = subprocess.run(
        ["unshare", "--mount", "sh", "-c", IN_A_BOX_OF_ITS_OWN, "sh",
         tmp_path / "box", package, tmp_path / "new.deb"],
        check=False, capture_output=True, text=True, timeout=400,
    )  # fmt: skip
    if done.returncode == 77:
        pytest.skip("this machine does not let a layer be mounted over its files")
    assert done.returncode == 0, done.stdout + done.stderr
    steps = re.findall(r"^(?:first|upgraded|gone back|removed|purged): .*", done.stdout, re.MULTILINE)
    assert steps == [
        f"first: {old}, daqsvc {daqsvc.__version__}, daqsvc",
        f"upgraded: {old}.1, /etc/daqsvc: pump.toml /var/lib/daqsvc: pump",
        f"gone back: {old}",
        "removed: etc/daqsvc/pump.toml var/lib/daqsvc/pump",
        "purged: etc/daqsvc/pump.toml var/lib/daqsvc/pump",
    ]
