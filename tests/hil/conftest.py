"""Tests on real SocketCAN interfaces: run by ``make hil``, which promises that there are some."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from support.vcan_links import VcanLink

if TYPE_CHECKING:
    from collections.abc import Iterator

HERE = Path(__file__).parent


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    if os.environ.get("DAQSVC_HIL") == "1":
        return
    for item in items:
        if HERE in item.path.parents:
            item.add_marker(pytest.mark.skip(reason="needs CAN interfaces of the kernel: make hil"))


@pytest.fixture
def vcan() -> Iterator[VcanLink]:
    """A CAN FD interface of its own for each test; without one the test fails."""
    link = VcanLink()
    try:
        yield link
    finally:
        link.close()
