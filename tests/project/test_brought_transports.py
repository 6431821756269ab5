"""A transport from outside the tree is put through the conformance suite, if DAQSVC_TRANSPORTS names it."""

from __future__ import annotations

import os
import subprocess
import sys
from typing import TYPE_CHECKING

import pytest
from support.paths import ROOT

if TYPE_CHECKING:
    from pathlib import Path

pytestmark = pytest.mark.integration
MODULE = """
from conformance.virtual_can_transport import VirtualCan


class Brought(VirtualCan):
    name = "brought along"
    cannot = {"be absent": "its wire tells nothing"}


TRANSPORTS = {Brought.name: Brought}
"""


@pytest.mark.long
def test_a_transport_from_outside_goes_through_the_suite(tmp_path: Path) -> None:
    (tmp_path / "brought_transport.py").write_text(MODULE)
    which = "brought and (delivered_in_its_place or absent_at_start)"
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", "-rs", "tests/conformance", "-k", which],
        cwd=ROOT,
        env=os.environ | {"DAQSVC_TRANSPORTS": "brought_transport", "PYTHONPATH": str(tmp_path)},
        capture_output=True,
        text=True,
        check=False,
        timeout=120,
    )
    assert "1 passed, 3 skipped" in done.stdout, done.stdout + done.stderr
    assert "brought along cannot be absent: its wire tells nothing" in done.stdout
