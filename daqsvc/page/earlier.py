"""What the history on the box knows of the time before anybody looked."""

from __future__ import annotations

import sqlite3
from contextlib import contextmanager
from typing import TYPE_CHECKING

import numpy as np

from daqsvc.acquisition.clock import NS_PER_S
from daqsvc.history.file import EmptyHistoryError, HistoryReader, NewerHistoryError
from daqsvc.history.points import Step
from daqsvc.page.machine_live import Earlier

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from daqsvc.page.machine_live import MachineLive

LONGEST_S = 300
"""How much of the time before is looked up."""


@contextmanager
def opened_history(live: MachineLive) -> Iterator[HistoryReader | None]:
    """The history of a machine's box meanwhile; None if there is none, or none that can be read."""
    reader: HistoryReader | None = None
    if live.history is not None and live.history.is_file():
        try:
            reader = HistoryReader(live.history)
        except (sqlite3.Error, NewerHistoryError, EmptyHistoryError):
            reader = None
    try:
        yield reader
    finally:
        if reader is not None:
            reader.close()


def probabilities_before(live: MachineLive, detector: str, modes: Sequence[str], until_ns: int) -> Earlier:
    """The probabilities of modes before a time, each second, as far as they were recorded; blocks.

    Args:
        live: the machine.
        detector: whose.
        modes: the columns.
        until_ns: by the box's monotonic clock.
    """
    until_s = (until_ns + live.wall_ns_at_0) / NS_PER_S
    since_s = int(until_s) - LONGEST_S
    values = np.full((LONGEST_S, len(modes)), np.nan)
    with opened_history(live) as reader:
        known = [] if reader is None else reader.series(live.name)
        for one in known:
            if (one.detector, one.kind) != (detector, "probabilities") or one.key not in modes:
                continue
            try:
                points = reader.trend(one, Step.SECOND, since_s, until_s) if reader else None
            except sqlite3.Error:
                continue
            if points is not None:
                place = points.t_s - since_s
                there = (place >= 0) & (place < LONGEST_S)
                values[place[there], modes.index(one.key)] = points.mean[there]
    is_known = np.isfinite(values).any(axis=1)
    t_s = since_s + np.flatnonzero(is_known)
    return Earlier(t_s * NS_PER_S - live.wall_ns_at_0, values[is_known])
