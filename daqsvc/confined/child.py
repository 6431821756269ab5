"""The process that does the work: a call at a time, each within its limits, until its input ends.

A request is a line of JSON; a reply is the length of a JSON header in eight bytes, the header, and the
arrays that it announces as they lie in memory. Nothing is pickled: what comes back from a damaged process is
numbers.
"""

from __future__ import annotations

import contextlib
import importlib
import json
import os
import resource
import signal
import struct
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

LENGTH = struct.Struct("<Q")


def serve() -> None:
    """Answer requests until there are no more."""
    # Ctrl-C goes to the whole group of processes; whoever waits for this one ends it.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    requests = sys.stdin.buffer
    # What a library prints must not get between the replies.
    with os.fdopen(os.dup(1), "wb") as replies:
        os.dup2(2, 1)
        while line := requests.readline():
            _answer(json.loads(line), replies)


def _answer(request: Mapping[str, Any], replies: BinaryIO) -> None:
    if directory := request["directory"]:
        # Where no process may go, whole paths still lead to files.
        with contextlib.suppress(OSError):
            os.chdir(directory)
    _confine(request["memory_bytes"], request["cpu_s"])
    module, _, name = request["function"].partition(":")
    arrays: Sequence[NDArray[np.generic]] = ()
    header: dict[str, Any] = {}
    try:
        result, arrays = getattr(importlib.import_module(module), name)(**request["arguments"])
        header = {"found": result, "arrays": [(array.dtype.str, array.shape) for array in arrays]}
    except MemoryError:
        header, arrays = {"raised": "MemoryError", "message": ""}, ()
    except Exception as error:  # noqa: BLE001 - whoever asked decides what it means
        code = f"{getattr(error, 'code', '')}"
        header, arrays = {"raised": type(error).__name__, "message": f"{error}", "code": code}, ()
    encoded = json.dumps(header).encode()
    replies.write(LENGTH.pack(len(encoded)) + encoded)
    for array in arrays:
        if array.size:
            replies.write(np.ascontiguousarray(array).reshape(-1).view(np.uint8).data)
    replies.flush()


def _confine(memory_bytes: int, cpu_s: float) -> None:
    """Bound what is taken from now on."""
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0])
    now_bytes = pages * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (now_bytes + memory_bytes, resource.RLIM_INFINITY))
    used = resource.getrusage(resource.RUSAGE_SELF)
    # Of whole seconds; at the limit the kernel ends the process.
    limit_s = int(used.ru_utime + used.ru_stime + cpu_s) + 1
    resource.setrlimit(resource.RLIMIT_CPU, (limit_s, resource.RLIM_INFINITY))
