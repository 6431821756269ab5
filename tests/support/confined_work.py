"""What a confined process is asked to do in tests: its work, more than its share, or its own end."""

from __future__ import annotations

import ctypes
import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    Answer = tuple[Any, Sequence[NDArray[Any]]]


def double(numbers: Sequence[float]) -> Answer:
    return {"pid": os.getpid()}, [2.0 * np.asarray(numbers), np.empty((0, 3))]


def whereabouts() -> Answer:
    return {"directory": f"{Path.cwd()}", "pid": os.getpid()}, []


def chatter() -> Answer:
    sys.stdout.write("x" * 10_000)
    sys.stderr.write("y" * 10_000)
    return "said", []


def take_memory(count: int) -> Answer:
    return float(np.ones(count).sum()), []


def spin() -> NoReturn:
    while True:
        pass


def crash() -> None:
    ctypes.string_at(0)


def leave() -> NoReturn:
    os._exit(7)


def fail() -> NoReturn:
    raise KeyError("no such thing")


def grow(rows: int) -> Answer:
    # The JSON is short, what it announces is large.
    return None, [np.zeros(1)] * rows


def spin_with(**_: object) -> NoReturn:
    spin()
