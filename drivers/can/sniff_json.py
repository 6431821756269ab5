"""What ``daqsvc sniff can --json`` prints."""

from __future__ import annotations

from typing import Annotated, Any, NotRequired, TypedDict

from drivers.counter_search import FrameCounter


class CanLoad(TypedDict):
    """How much of the bus is in use, as a share of the time.

    Attributes:
        least: without stuff bits.
        most: with as many stuff bits as there can be.
    """

    least: float
    most: float


class CanIdFigures(TypedDict):
    """The frames of one id.

    Attributes:
        id: the id.
        extended: whether it has 29 bits.
        remote: whether they are remote-transmission requests.
        fd: whether there are CAN FD frames among them.
        bit_rate_switch: whether there are frames with a second bit rate among them.
        frames: how many frames there were.
        lengths: lengths of their data, in bytes.
        rate_hz: frames per second; null if there were too few.
        period_s: mean time from frame to frame; null if there were too few.
        period_std_s: standard deviation of that time; null if there were too few.
        period_min_s: least time from frame to frame; null if there were too few.
        period_max_s: greatest time from frame to frame; null if there were too few.
        changed_bytes: numbers of the bytes that changed.
        last: data of the last frame, in hexadecimal digits.
        counter: what looks like a counter of frames; null if nothing does.
        message: name of the message in the DBC file; null if there is none.
    """

    id: int
    extended: bool
    remote: bool
    fd: bool
    bit_rate_switch: bool
    frames: int
    lengths: list[int]
    rate_hz: float | None
    period_s: float | None
    period_std_s: float | None
    period_min_s: float | None
    period_max_s: float | None
    changed_bytes: list[int]
    last: str
    counter: Annotated[dict[str, Any], FrameCounter] | None
    message: str | None


class DbcSignalFigures(TypedDict):
    """A signal of a message.

    Attributes:
        signal: name of the signal.
        unit: unit of the signal; empty if the DBC file gives none.
        frames: how many frames had a value of it.
        last: the last value.
        min: the least value.
        max: the greatest value.
        mean: the mean of the values.
        deviation: the standard deviation of the values, their RMS about the mean.
        dbc_min: the least value by the DBC file; null if it states none.
        dbc_max: the greatest value by the DBC file; null if it states none.
        doubt: what is strange about its values if the file is that of the device; empty if nothing is.
        counts_frames: whether it grew by 1 from frame to frame.
        rises: whether it rose all the time, as a clock does, until it began again at 0.
        step: by how much it grew from frame to frame; null if that varied.
        multiplexed: whether only some frames of the message have it.
    """

    signal: str
    unit: str
    frames: int
    last: float
    min: float
    max: float
    mean: float
    deviation: float
    dbc_min: float | None
    dbc_max: float | None
    doubt: str
    counts_frames: bool
    rises: bool
    step: int | None
    multiplexed: bool


class DbcMessageFigures(TypedDict):
    """A message of the DBC file that was heard.

    Attributes:
        message: name of the message.
        id: its id.
        frames: how many frames there were.
        frames_short: how many of them were too short.
        frames_long: how many of them were too long.
        length_doubt: that they were too long for a stream to read them; empty if not.
        rate_doubt: that they came clearly more often than the DBC file states; empty if not.
        signals: its signals of which there were values.
    """

    message: str
    id: int
    frames: int
    frames_short: int
    frames_long: int
    length_doubt: str
    rate_doubt: str
    signals: list[DbcSignalFigures]


class DbcFigures(TypedDict):
    """What is known by the DBC file.

    Attributes:
        messages: messages that were heard.
        not_heard: names of the others.
    """

    messages: list[DbcMessageFigures]
    not_heard: list[str]


class CanFigures(TypedDict):
    """What is on a CAN bus.

    Attributes:
        bus: kind of the bus.
        interface: kind of the interface.
        channel: name of the interface.
        seconds: how long was listened.
        frames: frames that were heard.
        frames_dropped: frames that the kernel dropped.
        error_frames: error frames.
        errors: what the error frames reported, by kind.
        controller_state: state of the controller as last reported; null if it was not.
        bitrate: bit rate; null if it is not known.
        data_bitrate: bit rate of the data of CAN FD; null if it is not known.
        load: how much of the bus is in use; null if the bit rate is not known.
        ids: the frames by id.
        dbc: what is known by the DBC file, with `--dbc` only.
    """

    bus: str
    interface: str
    channel: str
    seconds: float
    frames: int
    frames_dropped: int
    error_frames: int
    errors: dict[str, int]
    controller_state: str | None
    bitrate: int | None
    data_bitrate: int | None
    load: CanLoad | None
    ids: list[CanIdFigures]
    dbc: NotRequired[DbcFigures]
