"""A process that works for this one and can be lost: what it may take is bounded."""

from __future__ import annotations

import atexit
import contextlib
import json
import os
import select
import signal
import subprocess
import sys
import time
from dataclasses import dataclass
from tempfile import gettempdir
from threading import RLock
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, Self

import numpy as np

from daqsvc.confined.child import LENGTH
from daqsvc.confined.spilled import LEAST_BYTES, spilled

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

Reason = Literal["memory", "time", "crash"]

_WALL_PER_CPU = 4.0
_WALL_BASE_S = 60.0
"""How long an answer may take: a process that is stuck uses no processor time."""

_LONGEST_HEADER = 256_000_000
_END_S = 2.0

_ENVIRONMENT = {
    # Threads that are not needed take address space, which is what is bounded; so do the pools of Arrow.
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
    "ARROW_DEFAULT_MEMORY_POOL": "system",
}


class ConfinedError(Exception):
    """The work was not done: it took too much memory or time, or crashed the process that did it.

    Attributes:
        reason: which of these.
        how: how it ended, in words.
    """

    def __init__(self, reason: Reason, how: str) -> None:
        super().__init__(how)
        self.reason = reason
        self.how = how


class RaisedThereError(Exception):
    """The work raised an error.

    Attributes:
        kind: name of the error's class.
        message: what it states.
        code: the code of its kind (`daqsvc.errors`); empty if it has none.
    """

    def __init__(self, kind: str, message: str, code: str = "") -> None:
        super().__init__(f"{kind}: {message}")
        self.kind = kind
        self.message = message
        self.code = code


class WorkResult(NamedTuple):
    """What the work has found.

    Attributes:
        document: what JSON can say.
        arrays: and the numbers.
    """

    document: Any
    arrays: Sequence[NDArray[Any]]


@dataclass(slots=True)
class _Running:
    name: str
    process: subprocess.Popen[bytes]
    requests: int
    replies: int


class ConfinedProcess:
    """Calls functions in a separate process, one at a time.

    The process starts with the first call, and again after a loss.

    Calls of several threads wait for each other. It ends with `close`, or with this process.

    Args:
        name: what it is called where it failed, e.g. ``"its reader"`` of a file.
    """

    def __init__(self, name: str = "its reader") -> None:
        self._name = name
        self._lock = RLock()
        self._running: _Running | None = None
        self._aborted = False

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def call(
        self,
        function: str,
        arguments: Mapping[str, Any],
        *,
        memory_bytes: int,
        cpu_s: float,
        spill: bool = False,
    ) -> WorkResult:
        """Call a function there.

        Args:
            function: ``module:name``; it returns what JSON can say and a sequence of arrays without objects.
            arguments: of it, as JSON can say them.
            memory_bytes: what it may take beyond what the process has, in address space.
            cpu_s: processor time that it may take.
            spill: leave large arrays that come back in files, to be read piece by piece
                (`daqsvc.confined.spilled`).

        Raises:
            ConfinedError: it took more than that, or crashed.
            RaisedThereError: it raised an error.
        """
        request = {
            "function": function,
            "arguments": dict(arguments),
            "memory_bytes": memory_bytes,
            "cpu_s": cpu_s,
            "directory": _directory(),
        }
        with self._lock:
            running = self._running = self._running or _begin(self._name)
            if self._aborted:
                raise ConfinedError("crash", f"{self._name} was stopped")
            until = time.monotonic() + _WALL_BASE_S + _WALL_PER_CPU * cpu_s
            try:
                return _ask(running, request, memory_bytes, until, spill=spill)
            except RaisedThereError as error:
                if error.kind != "MemoryError":
                    raise
                self._kill()  # some of the memory may not have come back
                raise ConfinedError("memory", "it takes more memory than it may") from None
            except BaseException:
                # Whatever it would still say belongs to no question any more.
                self._kill()
                raise

    def abort(self) -> None:
        """Have the call of another thread end at once, and any other until `close`; does not block."""
        self._aborted = True
        if (running := self._running) is not None:
            running.process.kill()

    def close(self) -> None:
        """End the process; the next call begins another."""
        with self._lock:
            self._aborted = False
            if self._running is None:
                return
            os.close(self._running.requests)
            self._running.requests = -1
            with contextlib.suppress(subprocess.TimeoutExpired):
                self._running.process.wait(_END_S)
            self._kill()

    def _kill(self) -> None:
        if self._running is None:
            return
        running, self._running = self._running, None
        running.process.kill()
        running.process.wait()
        os.close(running.replies)
        if running.requests >= 0:
            os.close(running.requests)


def _directory() -> str | None:
    """Where names of files begin; None if that is gone."""
    try:
        return os.getcwd()  # noqa: PTH109 - of this moment, as the process may be older
    except OSError:
        return None


def _begin(name: str) -> _Running:
    """Begin the process: this interpreter and its modules, none of the working directory."""
    code = f"import sys; sys.path[:] = {sys.path!r}; from daqsvc.confined.child import serve; serve()"
    request_in, request_out = os.pipe()
    reply_in, reply_out = os.pipe()
    try:
        process = subprocess.Popen(  # noqa: S603 - this interpreter and our own code
            [sys.executable, "-I", "-c", code],
            stdin=request_in,
            stdout=reply_out,
            stderr=subprocess.DEVNULL,
            env={**os.environ, **_ENVIRONMENT},
        )
    except BaseException:
        os.close(request_out)
        os.close(reply_in)
        raise
    finally:
        os.close(request_in)
        os.close(reply_out)
    return _Running(name, process, request_out, reply_in)


def _ask(
    running: _Running, request: Mapping[str, Any], memory_bytes: int, until: float, *, spill: bool
) -> WorkResult:
    try:
        rest = json.dumps(request).encode() + b"\n"
        while rest:
            rest = rest[os.write(running.requests, rest) :]
    except BrokenPipeError:
        raise _lost(running) from None
    (length,) = LENGTH.unpack(_take(running, bytearray(LENGTH.size), until))
    if length > _LONGEST_HEADER:
        raise ConfinedError("crash", f"{running.name} answered without sense")
    header = json.loads(bytes(_take(running, bytearray(length), until)))
    if "raised" in header:
        raise RaisedThereError(header["raised"], header["message"], header.get("code", ""))
    kinds = [(np.dtype(kind), tuple(shape)) for kind, shape in header["arrays"]]
    if sum(kind.itemsize * float(np.prod(shape, dtype=np.float64)) for kind, shape in kinds) > memory_bytes:
        raise ConfinedError("memory", "what it holds takes more memory than it may")
    arrays = [_receive(running, kind, shape, until, spill=spill) for kind, shape in kinds]
    return WorkResult(header["found"], arrays)


def _receive(
    running: _Running, kind: np.dtype[Any], shape: tuple[int, ...], until: float, *, spill: bool
) -> NDArray[Any]:
    """An array that the process sends."""
    size = kind.itemsize * int(np.prod(shape))
    if spill and size >= LEAST_BYTES:
        try:
            return spilled(kind, shape, lambda piece: _take(running, piece, until))
        except OSError as error:
            raise ConfinedError("memory", f"it does not fit into {gettempdir()} ({error.strerror})") from None
    array: NDArray[Any] = np.empty(shape, kind)
    if array.size:
        _take(running, array.reshape(-1).view(np.uint8).data, until)
    return array


def _take(running: _Running, into: bytearray | memoryview, until: float) -> bytearray | memoryview:
    """Fill a buffer with what the process states.

    Raises:
        ConfinedError: it has ended, or states nothing.
    """
    left = memoryview(into)
    poll = select.poll()
    poll.register(running.replies, select.POLLIN)
    while left:
        if not poll.poll(max(0.0, until - time.monotonic()) * 1e3):
            raise ConfinedError("time", f"{running.name} is stuck")
        count = os.readv(running.replies, [left])
        if not count:
            raise _lost(running)
        left = left[count:]
    return into


def _lost(running: _Running) -> ConfinedError:
    try:
        code = running.process.wait(_END_S)
    except subprocess.TimeoutExpired:
        return ConfinedError("crash", f"{running.name} closed its output")
    if code == -signal.SIGXCPU:
        return ConfinedError("time", "it takes more processor time than it may")
    if code < 0:
        return ConfinedError("crash", f"{running.name} was ended by {_signal_name(-code)}")
    return ConfinedError("crash", f"{running.name} ended with exit code {code}")


def _signal_name(number: int) -> str:
    try:
        return signal.Signals(number).name
    except ValueError:
        return f"signal {number}"


shared = ConfinedProcess()
"""The one that reads the recordings of a command; a service has one for each file, which ends with it."""

atexit.register(shared.close)
