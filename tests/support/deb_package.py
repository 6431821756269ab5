"""The Debian package of this tree, built once for all runs that test the same sources.

``python -m support.deb_package`` prints where it and the later version are, for a guest, which builds none.
"""

from __future__ import annotations

import hashlib
import io
import os
import shutil
import subprocess
import sys
import tarfile
from pathlib import Path

from support.made_once import made_in
from support.paths import ROOT

KEPT = ROOT / ".cache" / "deb"
_NOT_COPIED = (".*", "__pycache__", "*.egg-info", "build", "dist")
# Pages of the documentation link to tests; what is packed is hardly another for that.
_NOT_IN_IT = shutil.ignore_patterns(*_NOT_COPIED, "tests")


def packages() -> tuple[Path, Path]:
    """The package of the sources as they are now, and the same as a later version."""
    KEPT.mkdir(parents=True, exist_ok=True)
    name = _digest(ROOT)
    made = made_in(KEPT, name, _build)
    for old in KEPT.iterdir():
        if not old.name.startswith(name):
            shutil.rmtree(old) if old.is_dir() else old.unlink()
    return made


def _digest(tree: Path) -> str:
    """Of all that is packed."""
    digest = hashlib.sha256()
    for folder, folders, files in os.walk(tree):
        left_out = _NOT_IN_IT(folder, [*folders, *files])
        folders[:] = sorted(set(folders) - left_out)
        for name in sorted(set(files) - left_out):
            text = Path(folder, name).read_bytes()
            digest.update(f"{Path(folder, name).relative_to(tree)} {len(text)} ".encode() + text)
    return digest.hexdigest()[:16]


def _build(folder: Path) -> tuple[Path, Path]:
    shutil.rmtree(folder)  # what a build that was interrupted has left
    tree = folder / "tree"
    shutil.copytree(ROOT, tree, ignore=shutil.ignore_patterns(*_NOT_COPIED))
    ready = Path(sys.prefix) / ".ready"
    built = subprocess.run(
        ["make", "--assume-old", str(ready), "deb", f"VENV={sys.prefix}", "DIST=out",
         f"DOCS_VENV={ROOT / '.venv-docs'}"],
        cwd=tree, check=False, capture_output=True, text=True, timeout=560,
    )  # fmt: skip
    assert built.returncode == 0, built.stdout + built.stderr
    [deb] = (tree / "out").glob("daqsvc_*.deb")
    return deb, _newer(deb, folder / "newer")


def _newer(deb: Path, folder: Path) -> Path:
    """The same files with a higher version in the description, which leaves what is packed as it is."""
    folder.mkdir()
    _, version, architecture = deb.name.split("_")
    subprocess.run(["ar", "x", deb], cwd=folder, check=True, timeout=100)
    changed = io.BytesIO()
    with (
        tarfile.open(folder / "control.tar.xz") as before,
        tarfile.open(fileobj=changed, mode="w:xz") as after,
    ):
        for member in before:
            file = before.extractfile(member)
            text = b"" if file is None else file.read()
            if member.name == "./control":
                text = text.replace(f"Version: {version}\n".encode(), f"Version: {version}.1\n".encode())
                member.size = len(text)
            after.addfile(member, io.BytesIO(text))
    (folder / "control.tar.xz").write_bytes(changed.getvalue())
    newer = folder / f"daqsvc_{version}.1_{architecture}"
    parts = ["debian-binary", "control.tar.xz", "data.tar.xz"]
    subprocess.run(["ar", "rcD", newer, *parts], cwd=folder, check=True, timeout=100)
    for part in parts:
        (folder / part).unlink()
    return newer


if __name__ == "__main__":
    sys.stdout.write(" ".join(map(str, packages())) + "\n")
