"""What kernels are compiled by: Numba's ``njit``, and that it has to compile one is said.

Heavy to import: only modules with kernels do.
"""

from __future__ import annotations

from typing import Any

from numba import njit
from numba.core import event

from daqsvc import kernel_cache

__all__ = ["njit"]


class _Compiling(event.Listener):
    """Hears of each function that is compiled; one that was kept is not."""

    def on_start(self, event: object) -> None:
        del event
        kernel_cache.say_compiling()

    def on_end(self, event: object) -> None:
        pass


_events: Any = event
_events.register("numba:compile", _Compiling())
