"""What ``daqsvc sim`` prints of a stream that was played."""

from __future__ import annotations

from typing import NotRequired, TypedDict


class PlayedStream(TypedDict):
    """What was played of a stream; some keys are absent where replies are sent, and no frames.

    Attributes:
        samples_sent: samples that were sent.
        frames_sent: frames that were sent.
        frames_unsent: frames that the link has not taken.
        send_retries: how often a frame was sent again, as the link had not taken it.
        injected: faults that were made, by kind.
    """

    samples_sent: int
    frames_sent: NotRequired[int]
    frames_unsent: NotRequired[int]
    send_retries: NotRequired[int]
    injected: dict[str, int]
