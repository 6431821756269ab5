"""Every transport that a module ``*_transport.py`` of this folder brings is put through the whole suite.

So is what the modules bring that ``DAQSVC_TRANSPORTS`` names, with a colon between them.
"""

from __future__ import annotations

import importlib
import os
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
import pytest_asyncio
from conformance.rig import transports_of

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from conformance.transport import Transport

OURS = sorted(f"conformance.{file.stem}" for file in Path(__file__).parent.glob("*_transport.py"))
BROUGHT = [module for module in os.environ.get("DAQSVC_TRANSPORTS", "").split(":") if module]
FACTORIES = {
    name: factory
    for module in [*OURS, *BROUGHT]
    for name, factory in transports_of(importlib.import_module(module)).items()
}


@pytest_asyncio.fixture(params=FACTORIES)
async def transport(request: pytest.FixtureRequest, tmp_path: Path) -> AsyncIterator[Transport]:
    """A transport that has started; one whose wire cannot do what the test is about is skipped by name."""
    made = FACTORIES[request.param](tmp_path)
    if (ability := request.node.get_closest_marker("needs")) and ability.args[0] in made.cannot:
        pytest.skip(f"{made.name} cannot {ability.args[0]}: {made.cannot[ability.args[0]]}")
    await made.start()
    try:
        yield made
    finally:
        await made.stop()
