"""Many recordings, each by itself, in the order given, on as many processes as wanted."""

from __future__ import annotations

import multiprocessing
import os
import signal
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol

from daqsvc import kernel_cache
from daqsvc.recording.recording import get_limits, set_limits

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from daqsvc.confined.limits import ResourceLimits

_BLAS_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


class WorkerLostError(Exception):
    """A process died that was working on a recording."""


@dataclass(frozen=True, slots=True)
class Outcome:
    """What is printed about a recording.

    Attributes:
        json: the JSON object.
        text: the same in words.
        refused: whether the recording could not be judged.
    """

    json: dict[str, Any]
    text: str
    refused: bool


class Analyst(Protocol):
    """Judges a recording; goes to another process by pickle."""

    def judge(
        self, recording: str, figures: str | None, progress: Callable[[int, int], None] | None = None
    ) -> Outcome:
        """Judge the recording at a path.

        Args:
            recording: the file.
            figures: what the names of its figures begin with; None: no figures.
            progress: told the samples done and to do.
        """
        ...


def judge_all(
    analyst: Analyst, recordings: Sequence[str], figures: Sequence[str | None], processes: int
) -> Iterator[Outcome]:
    """Outcomes in the order of the recordings, each as soon as it and all before it are there.

    Args:
        analyst: judges them.
        recordings: the files.
        figures: for each, what the names of its figures begin with.
        processes: how many at a time; with one, this process does it.

    Raises:
        WorkerLostError: a process was killed.
    """
    if processes == 1:
        for recording, prefix in zip(recordings, figures, strict=True):
            yield analyst.judge(recording, prefix)
        return
    # One process a core: threads of the linear algebra inside each would only get in each other's way.
    for name in _BLAS_THREADS:
        os.environ.setdefault(name, "1")
    pool = ProcessPoolExecutor(
        processes,
        multiprocessing.get_context("spawn"),
        initializer=_prepare,
        initargs=(analyst, get_limits()),
    )
    try:
        jobs = [pool.submit(_judge, *job) for job in zip(recordings, figures, strict=True)]
        for recording, job in zip(recordings, jobs, strict=True):
            try:
                yield job.result()
            except BrokenProcessPool:
                raise WorkerLostError(
                    f"a process was killed while {recording} was waited for (out of memory?); "
                    "give fewer --jobs"
                ) from None
    finally:
        pool.shutdown(cancel_futures=True)


_analysts: list[Analyst] = []
"""In a process of the pool: the one that judges there, so that what it has read is read once."""


def _judge(recording: str, figures: str | None) -> Outcome:
    return _analysts[0].judge(recording, figures)


def _prepare(analyst: Analyst, limits: ResourceLimits) -> None:
    """Read as the parent would; and leave Ctrl-C, which goes to the whole group, to it."""
    _analysts.append(analyst)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    set_limits(limits)
    kernel_cache.prepare(say=False)
