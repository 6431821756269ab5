"""From samples to timed frames, and what is left of the samples after that."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from daqsvc.acquisition.clock import NS_PER_S

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from drivers.frames import FrameLayout


@dataclass(frozen=True, slots=True)
class TimedFrames:
    """Frames of one id in the order of time.

    Attributes:
        t_ns: int64 ``[n]``, when the last sample of each frame is taken; sample 0 is taken at 0.
        payloads: uint8 ``[n, length]``.
    """

    t_ns: NDArray[np.int64]
    payloads: NDArray[np.uint8]


def check_samples(
    samples: NDArray[np.float64] | NDArray[np.float32], layout: FrameLayout, rate_hz: float
) -> None:
    """Refuse samples that cannot be put into frames.

    Raises:
        ValueError: as `to_frames`, but for values that do not fit.
    """
    if samples.ndim != 2 or samples.shape[1] != len(layout.channels):
        raise ValueError(
            f"samples are {list(samples.shape)}; frame {layout.frame_id:#x} takes [n, "
            f"{len(layout.channels)}], one column for each of {', '.join(layout.channels)}"
        )
    if rate_hz <= 0:
        raise ValueError(f"rate_hz is {rate_hz}; it must be positive")
    if len(samples) < layout.samples_per_frame:
        raise ValueError(
            f"{len(samples)} samples do not fill one frame {layout.frame_id:#x} of "
            f"{layout.samples_per_frame}; give more"
        )


def to_frames(
    samples: NDArray[np.float64] | NDArray[np.float32],
    layout: FrameLayout,
    rate_hz: float,
    *,
    first_index: int = 0,
    clip: bool = False,
) -> TimedFrames:
    """Put samples into frames; those left over at the end that do not fill a frame stay behind.

    Args:
        samples: ``[n, channels]`` in the layout's physical units, in the order of its channels.
        layout: where the samples go.
        rate_hz: samples per second.
        first_index: the device's sample count at ``samples[0]``.
        clip: saturate values that do not fit, as an analogue input does, instead of raising.

    Raises:
        ValueError: the channels do not match, there is not one whole frame of samples, or a value
            does not fit the layout.
    """
    check_samples(samples, layout, rate_hz)
    per_frame = layout.samples_per_frame
    n = len(samples) // per_frame
    start = np.arange(n, dtype=np.int64) * per_frame
    whole = samples[: n * per_frame].reshape(n, per_frame, -1)
    return TimedFrames(
        t_ns=np.rint((start + per_frame - 1) * (NS_PER_S / rate_hz)).astype(np.int64),
        payloads=layout.encode(first_index + start, whole, clip=clip),
    )


def quantised(
    samples: NDArray[np.float64] | NDArray[np.float32], layout: FrameLayout, *, clip: bool = False
) -> NDArray[np.float32]:
    """Samples as a receiver will see them, after the wire's resolution.

    Args:
        samples: ``[n, channels]`` in the layout's physical units.
        layout: of the frames that would carry them.
        clip: as in `to_frames`.

    Returns:
        float32 ``[m, channels]`` with ``m`` the largest multiple of a frame's samples up to ``n``.

    Raises:
        ValueError: as `to_frames`.
    """
    frames = to_frames(samples, layout, 1.0, clip=clip)
    return layout.decode(frames.payloads).samples.reshape(-1, len(layout.channels))
