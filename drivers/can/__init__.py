"""CAN and CAN FD buses."""

from __future__ import annotations

import sys
from importlib.abc import MetaPathFinder
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Sequence
    from importlib.machinery import ModuleSpec
    from types import ModuleType


class _WithoutMdf(MetaPathFinder):
    """Lets python-can do without asammdf: it takes that along if it is there, with pandas and Arrow.

    They would cost each service 50 MB and a second at its start, for a kind of file that it neither reads nor
    writes by python-can.
    """

    def find_spec(self, name: str, path: Sequence[str] | None, target: ModuleType | None = None) -> None:
        """Refuse it while python-can's own module is being imported; anything else is left to others."""
        del path, target
        if name == "asammdf" and _is_being_imported("can.io.mf4"):
            raise ModuleNotFoundError(f"{name} is not wanted here", name=name)


def _is_being_imported(name: str) -> bool:
    spec: ModuleSpec | None = getattr(sys.modules.get(name), "__spec__", None)
    return bool(getattr(spec, "_initializing", False))


sys.meta_path.insert(0, _WithoutMdf())
