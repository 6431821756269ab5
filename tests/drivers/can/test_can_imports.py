"""What a service with a CAN bus imports, and what it does not."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest
from support.paths import ROOT

pytestmark = [pytest.mark.integration, pytest.mark.long]

IMPORTS = """
import sys
import drivers.can.driver
assert "can.io.mf4" in sys.modules
print([name for name in ("asammdf", "pandas", "pyarrow") if name in sys.modules])
import asammdf
print(asammdf.MDF.__name__)
"""


def test_python_can_brings_no_tables_along_and_recordings_still_can() -> None:
    pytest.importorskip("asammdf")
    environment = os.environ | {"PYTHONPATH": f"{ROOT}"}
    done = subprocess.run(
        [sys.executable, "-c", IMPORTS], capture_output=True, text=True, check=False, env=environment
    )
    assert done.stdout == "[]\nMDF\n", done.stderr
