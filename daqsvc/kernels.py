"""What kernels are compiled by: Numba's ``njit``, and what is done about one that has to be compiled.

That is logged: it takes long. A process that asked for it (`daqsvc.kernel_compiler`) has another one compile
and loads what that has kept. Heavy to import: only modules with kernels do.
"""

from __future__ import annotations

from typing import Any

from numba import njit
from numba.core import event, serialize
from numba.core.caching import FunctionCache

from daqsvc import kernel_cache
from daqsvc.kernel_compiler import compiler

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

_Cache: Any = FunctionCache
_pickled: Any = serialize.dumps
_load, _save = _Cache.load_overload, _Cache.save_overload


def _load_or_have_compiled(cache: Any, signature: object, target: object) -> object:
    """A kernel that is kept, or is so now; None if it is to be compiled here."""
    kept: object = _load(cache, signature, target)
    apart = compiler()
    if kept is not None or apart is None:
        return kept
    kernel_cache.say_compiling()
    if apart.compile(cache._py_func, _pickled(signature)):  # noqa: SLF001 - it has no other name
        kept = _load(cache, signature, target)
        if kept is None:
            apart.say_why_not(f"nothing was kept in {cache.cache_path}")
    return kept


def _save_if_possible(cache: Any, signature: object, compiled: object) -> None:
    """Keep a kernel; one that cannot be kept is of use all the same."""
    try:
        _save(cache, signature, compiled)
    except OSError as error:
        kernel_cache.say_not_kept(error)


_Cache.load_overload, _Cache.save_overload = _load_or_have_compiled, _save_if_possible
