"""What is dear to make, made by one of the workers of a test run and read by the others."""

from __future__ import annotations

import fcntl
import os
import pickle
from typing import TYPE_CHECKING, TypeVar

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    import pytest

T = TypeVar("T")


def made_once(factory: pytest.TempPathFactory, name: str, make: Callable[[Path], T]) -> T:
    """What ``make`` returns, for all workers; it gets a folder that stays until the end of the run."""
    run = factory.getbasetemp()
    return made_in(run.parent if "PYTEST_XDIST_WORKER" in os.environ else run, name, make)


def made_in(run: Path, name: str, make: Callable[[Path], T]) -> T:
    """As `made_once`, for all who name the same folder."""
    folder, kept = run / name, run / f"{name}.pickle"
    with (run / f"{name}.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not kept.exists():
            folder.mkdir(exist_ok=True)
            made = pickle.dumps(make(folder))
            kept.write_bytes(made)
        return pickle.loads(kept.read_bytes())  # type: ignore[no-any-return]  # noqa: S301 - of this very run
