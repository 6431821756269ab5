"""What the host does for the unit in the guest: compiles its kernels, and says how fast it is itself.

``python -m support.unit_kernels`` prints the latter.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time
from pathlib import Path

from support.machine_files import LAVAL

from daqsvc import kernel_cache


def warm() -> None:
    """Compile what the service of the rig needs, where the guest would take minutes."""
    kernel_cache.prepare()
    from daqsvc.detectors.make import detectors
    from daqsvc.settings import load_machine_file

    with tempfile.TemporaryDirectory() as store:
        for detector in detectors(load_machine_file(LAVAL), Path(store)):
            detector.warm()


def reference_s() -> float:
    """How long a process takes that loads what the service stands on: the best of three."""
    took_s = []
    for _ in range(3):
        begun_s = time.monotonic()
        subprocess.run([sys.executable, "-c", "import numba, scipy.linalg, pydantic, can"], check=True)
        took_s.append(time.monotonic() - begun_s)
    return min(took_s)


if __name__ == "__main__":
    warm()
    sys.stdout.write(f"{reference_s():.3f}\n")
