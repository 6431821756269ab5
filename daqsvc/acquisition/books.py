"""What is counted of the samples of any stream, and told of it once: gaps, and values that are absent."""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from daqsvc.acquisition.assembler import StreamCounters
    from daqsvc.acquisition.samples import Samples

logger = logging.getLogger(__name__)


def note_received(counters: StreamCounters, stream: str, samples: Samples) -> Samples:
    """Count samples that are handed on, and what in them is absent; the first such is told.

    A value is absent if the device says that it has none (NaN), or if it is infinite: that is what an
    overflow leaves, on the device or in a number that no float32 holds, and nothing that was measured.

    Args:
        counters: of the stream.
        stream: its name.
        samples: float32 ``[n, channels]``.

    Returns:
        The samples with NaN for what is absent; the same array if it says so already.
    """
    counters.samples_received += len(samples)
    there = np.isfinite(samples)
    if there.all():
        return samples
    absent = there.size - int(np.count_nonzero(there))
    if not counters.values_absent:
        logger.warning(
            "stream %r: %d of its values are no measurements: the device says that it has none, or what it "
            "sends is not finite; such values are missing, and are counted from now on. Look at the sensors "
            "behind it",
            stream,
            absent,
        )
    counters.values_absent += absent
    return samples if not np.isinf(samples).any() else np.where(there, samples, np.float32(np.nan))


def note_gap(counters: StreamCounters, stream: str, lost: int, first: int) -> None:
    """Count a gap; the first one is told.

    Args:
        counters: of the stream.
        stream: its name.
        lost: samples that are missing.
        first: index of the sample after them.
    """
    if not counters.gaps:
        logger.warning(
            "stream %r: %d samples are missing before index %d; gaps are counted from now on",
            stream,
            lost,
            first,
        )
    counters.gaps += 1
    counters.samples_lost += lost
