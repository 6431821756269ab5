"""What the host does for units in the guest: compiles their kernels, and measures how fast it is itself.

``python -m support.unit_kernels`` prints the latter.
"""

from __future__ import annotations

import importlib
import os
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from numba.core import caching
from support.machine_files import LAVAL
from support.paths import ROOT

from daqsvc import kernel_cache


def warm() -> None:
    """Compile what the service of the rig needs, where the guest would take minutes."""
    kernel_cache.prepare()
    # Those of samples are compiled by their modules, and only a bus imports these.
    importlib.import_module("daqsvc.acquisition.assembler")
    from daqsvc.detectors.make import detectors
    from daqsvc.settings import load_machine_file

    with tempfile.TemporaryDirectory() as store:
        for detector in detectors(load_machine_file(LAVAL), Path(store)):
            detector.warm()


def put_kernels(tree: Path, kept: Path) -> None:
    """Let a service whose sources lie elsewhere find what `warm` has compiled for those of this tree.

    Args:
        tree: where the same packages lie for that service.
        kept: where that service keeps its kernels.
    """
    warmed = Path(os.environ["NUMBA_CACHE_DIR"])
    path_of: Any = caching._CacheLocator.get_suitable_cache_subpath
    for source in {
        file.parent for package in ("daqsvc", "drivers") for file in (ROOT / package).rglob("*.py")
    }:
        compiled = warmed / path_of(f"{source}/x.py")
        if compiled.is_dir():
            shutil.copytree(compiled, kept / path_of(f"{tree / source.relative_to(ROOT)}/x.py"))


def reference_s() -> float:
    """How long a process takes that loads the libraries of the service: the best of three."""
    took_s = []
    for _ in range(3):
        begun_s = time.monotonic()
        subprocess.run([sys.executable, "-c", "import numba, scipy.linalg, pydantic, can"], check=True)
        took_s.append(time.monotonic() - begun_s)
    return min(took_s)


if __name__ == "__main__":
    warm()
    sys.stdout.write(f"{reference_s():.3f}\n")
