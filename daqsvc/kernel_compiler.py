"""Kernels compiled in a their own process: this one only loads them from where they are kept.

What the compiler takes stays with the process that has called it, some 130 MB; a service runs for months. So
whoever runs that long asks another process for each kernel that is not kept yet.
"""

from __future__ import annotations

import base64
import importlib
import logging
import os
import pickle
import signal
import time
from functools import cache, reduce
from threading import Condition, Thread
from typing import TYPE_CHECKING, Any

from daqsvc.confined.process import ConfinedError, ConfinedProcess, RaisedThereError
from daqsvc.errors.code import coded
from daqsvc.errors.service import KERNELS

if TYPE_CHECKING:
    from collections.abc import Callable

log = logging.getLogger(__name__)

IDLE_S = 5.0
"""The process ends when no kernel was asked for so long."""
MEMORY_BYTES = 4 << 30
CPU_S = 120.0
"""What one kernel may take on the slowest box; the large ones take some 5 s."""
LOOK_S = 0.2


class KernelCompiler:
    """Has kernels compiled, one at a time, by a separate process.

    The process starts with the first kernel and ends when it has no work. It ends with this process,
    however that ends. If it is lost no other is begun.
    """

    def __init__(self) -> None:
        self._process = ConfinedProcess("their compiler")
        self._turn = Condition()
        self._asked_s = 0.0
        self._ending: Thread | None = None
        self._lost = False
        self._has_logged = False

    def compile(self, function: Callable[..., Any], signature: bytes) -> bool:
        """Have a kernel compiled and kept; blocks.

        Args:
            function: the Python function, at the top of a module that can be imported.
            signature: what Numba compiles it for, pickled.

        Returns:
            Whether that was done. If not, the reason is logged once.
        """
        with self._turn:
            if self._lost:
                return False
            if self._ending is None:
                self._ending = Thread(target=self._end_when_idle, name="end of the compiler", daemon=True)
                self._ending.start()
            try:
                self._process.call(
                    f"{__name__}:compile_here",
                    {
                        "module": function.__module__,
                        "name": function.__qualname__,
                        "signature": base64.b64encode(signature).decode(),
                        "parent": os.getpid(),
                    },
                    memory_bytes=MEMORY_BYTES,
                    cpu_s=CPU_S,
                )
            except (ConfinedError, OSError) as error:
                self._lost = True
                self.say_why_not(f"{error}")
                return False
            except RaisedThereError as error:
                self.say_why_not(f"{function.__name__}: {error}")
                return False
            finally:
                self._asked_s = time.monotonic()
        return True

    def say_why_not(self, reason: str) -> None:
        """Say that a kernel must be compiled here, once."""
        if not self._has_logged:
            self._has_logged = True
            words = (
                "the service compiles kernels by itself, and takes some 130 MB more until its next start: %s"
            )
            log.warning(words, reason, extra=coded(KERNELS))

    def close(self) -> None:
        """End the process, as if there had been nothing to do for long."""
        with self._turn:
            self._asked_s = float("-inf")
            self._turn.notify_all()
            ending = self._ending
        if ending is not None:
            ending.join()

    def _end_when_idle(self) -> None:
        with self._turn:
            while (left_s := self._asked_s + IDLE_S - time.monotonic()) > 0:
                self._turn.wait(left_s)
            self._process.close()
            self._ending = None


def compile_here(module: str, name: str, signature: str, parent: int) -> tuple[None, tuple[()]]:
    """What that process does: compile a kernel, which is found by its module and name; Numba keeps it."""
    _belong_to(parent)
    from numba.core import sigutils  # noqa: PLC0415 - heavy, and needed there only

    kernel: Any = reduce(getattr, name.split("."), importlib.import_module(module))
    wanted: Any = pickle.loads(base64.b64decode(signature))  # noqa: S301 - it comes from the parent
    normalize: Any = sigutils.normalize_signature
    arguments, _ = normalize(wanted)
    # Some are compiled as soon as they are imported.
    if tuple(arguments) not in kernel.overloads:
        kernel.compile(wanted)
    return None, ()


@cache
def _belong_to(parent: int) -> None:
    """Live as long as the process that wants kernels."""
    # systemd tells all processes of a service to stop; this one is needed until the service has.
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    Thread(target=_end_with, args=(parent,), daemon=True).start()


def _end_with(parent: int) -> None:
    """End when a process is gone, also in the middle of a kernel."""
    while os.getppid() == parent:
        time.sleep(LOOK_S)
    os._exit(0)


_compiler: list[KernelCompiler] = []


def compile_apart() -> KernelCompiler:
    """Have kernels compiled in a their own process from now on; call before any is imported."""
    _compiler[:] = [KernelCompiler()]
    return _compiler[0]


def compiler() -> KernelCompiler | None:
    """The one that is to compile kernels; None if this process does."""
    return _compiler[0] if _compiler else None
