"""Prometheus and its tool, as Debian has them (apt-get install prometheus)."""

from __future__ import annotations

import os
import shutil

import pytest


def program(name: str) -> str:
    """The path of ``prometheus`` or ``promtool``; skips the test if it is absent, unless it is required."""
    path = shutil.which(name)
    if path is None:
        reason = f"no {name} on this machine (apt-get install prometheus)"
        if os.environ.get("DAQSVC_REQUIRE_PROMETHEUS") == "1":
            pytest.fail(reason)
        pytest.skip(reason)
    return path
