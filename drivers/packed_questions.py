"""What ``daqsvc new`` asks about frames that are packed with samples, on whichever bus they come."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from drivers import questions as q
from drivers.questions import NONE, Answers, Question, Topic
from drivers.sniffing import by_name, is_waveform_rate
from drivers.toml_lines import array, behind, entry, toml

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from drivers.bus_questions import BusQuestions

RAW_BYTES = {"int8": 1, "int16": 2, "int24": 3, "int32": 4, "uint8": 1, "uint16": 2, "uint24": 3, "uint32": 4}
TOPICS = {
    "counter-byte": Topic(
        "First byte of the counter in a frame",
        "From 0. By the counter lost samples are found; on CAN, none if the frames have none.",
    ),
    "counter-bits": Topic("Width of the counter, in bits", "The device's manual states it."),
    "counter-counts": Topic(
        "What does the counter count?", "It grows from frame to frame by 1, or by the samples in a frame."
    ),
    "byte-order": Topic("Which byte of a number comes first?", "little: the low one. big: the high one."),
    "first-byte": Topic("Byte of a frame where the samples begin", "From 0; mostly behind the counter."),
    "samples-per-frame": Topic("Samples of each channel in a frame", "The device's manual states it."),
}
COUNTS = {"samples": "it grows by the samples in a frame", "frames": "it grows by 1"}
_PROBE_V = 18.0
"""Lowest voltage of a proximity probe, in V below 0."""


def sample_questions(
    bus: BusQuestions, answers: Answers, room: int, *, must_count: bool = False, **more: Any
) -> Iterator[Question]:
    """How samples and the counter lie in a frame.

    Args:
        bus: whose topics have the words.
        answers: see `BusQuestions.questions`.
        room: bytes that a frame may have.
        must_count: whether frames without a counter cannot be read.
        more: see `Question`; of those that are not quiet anyway.
    """
    yield bus.ask("channels", q.names, "x, y, kph", **more)
    yield bus.choose("raw-type", dict.fromkeys(RAW_BYTES, ""), "int16", **more)
    yield bus.ask("scale", q.number, "0.001", **more)
    yield bus.ask("counter-byte", q.whole if must_count else q.whole_or_none, "0", quiet=True)
    if answers["counter-byte"] is not None:
        yield bus.choose("counter-bits", dict.fromkeys(("8", "16", "32"), ""), "16", quiet=True)
        yield bus.choose("counter-counts", COUNTS, "samples", quiet=True)
    yield bus.choose("byte-order", dict.fromkeys(("little", "big"), ""), "little", quiet=True)
    yield bus.ask("first-byte", q.whole, f"{_first_byte(answers, room)}", quiet=True)
    yield bus.ask("samples-per-frame", q.whole, f"{max(min(_most_samples(answers, room), 10), 1)}", **more)


def _most_samples(answers: Answers, room: int) -> int:
    """Samples of each channel that a frame has room for, up to the counter if that is behind them."""
    first: int = answers["first-byte"]
    begin, _ = _counter_bytes(answers)
    return ((begin if first < begin else room) - first) // sample_bytes(answers)


def _counter_bytes(answers: Answers) -> tuple[int, int]:
    """First byte of the counter, and one past its last; without one both are 0."""
    begin: int | None = answers["counter-byte"]
    return (0, 0) if begin is None else (begin, begin + int(answers["counter-bits"]) // 8)


def _first_byte(answers: Answers, room: int) -> int:
    """Behind the counter; in front of it where nothing has room behind."""
    _, end = _counter_bytes(answers)
    return end if end + sample_bytes(answers) <= room else 0


def sample_bytes(answers: Answers) -> int:
    """Bytes of one sample of every channel."""
    channels: int = len(answers["channels"])
    return channels * RAW_BYTES[answers["raw-type"]]


def end_byte(answers: Answers) -> int:
    """One past the last byte that holds counter or samples."""
    samples: int = answers["first-byte"] + sample_bytes(answers) * answers["samples-per-frame"]
    return max(samples, _counter_bytes(answers)[1])


def layout_lines(answers: Answers) -> Iterator[str]:
    """Lines of the layout, behind what is of the kind of bus only."""
    yield entry("byte_order", answers["byte-order"], '"big" if the device sends the high byte first')
    if answers["counter-byte"] is None:
        yield entry("no_counter", value=True, comment="losses are estimated from the times of arrival")
    else:
        counts = answers["counter-counts"]
        counter = {"byte": answers["counter-byte"], "bits": int(answers["counter-bits"]), "counts": counts}
        yield behind(
            f"counter = {toml(counter)}", f'or counts = "{"frames" if counts == "samples" else "samples"}"'
        )
    yield entry("first_byte", answers["first-byte"], "where the samples begin")
    yield entry("samples_per_frame", answers["samples-per-frame"])
    yield "# value = raw * scale: volts if the sensor below has a sensitivity, else its unit"
    kind, scale = answers["raw-type"], answers["scale"]
    yield from array("channels", [{"name": n, "type": kind, "scale": scale} for n in answers["channels"]])


def guess(answers: Answers, channel: str) -> tuple[str, str | None]:
    """See `BusQuestions.guess`."""
    named, signed = by_name(channel), not answers["raw-type"].startswith("u")
    carried_v = abs(answers["scale"]) * 2.0 ** (8 * RAW_BYTES[answers["raw-type"]] - 1)
    volts_of_probe = signed and carried_v > _PROBE_V and in_volts(answers)
    if named == "keyphasor" and not volts_of_probe:
        named = "trend"  # marks of a shaft are no vibration, whatever their unit is
    slow = not is_waveform_rate(answers["rate"])
    # An accelerometer is digitised with the same scale: only a keyphasor beside it shows that of a probe.
    probe = volts_of_probe and any(by_name(one) == "keyphasor" for one in answers["channels"])
    return named or ("proximity" if probe and not slow else "trend" if slow else "accelerometer"), None


def in_volts(answers: Answers) -> bool:
    """See `BusQuestions.in_volts`; all channels have one scale."""
    return bool(abs(answers["scale"]) < 0.5)  # no converter is so coarse


def frame_proposals(length: int, counter: Mapping[str, Any] | None, answers: Answers) -> dict[str, str]:
    """What a frame that was heard proposes; see `Heard.proposals`.

    Args:
        length: its bytes, those of the samples and the counter.
        counter: `drivers.counter_search.FrameCounter` as figures; None if nothing counts.
        answers: so far.
    """
    fits = {}
    if "first-byte" in answers and (most := _most_samples(answers, length)) >= 1:
        # A counter of samples states how many of them are in a frame.
        step = 1 if counter is None else counter["step"]
        fits["samples-per-frame"] = f"{step if step > 1 else most}"
    if counter is None:
        return {"counter-byte": NONE, **fits}
    step, end = counter["step"], counter["byte"] + counter["bits"] // 8
    proposed = {
        "counter-byte": f"{counter['byte']}",
        "counter-bits": f"{counter['bits']}",
        "counter-counts": "frames" if step == 1 else "samples",
    }
    if counter["bits"] > 8:
        proposed["byte-order"] = counter["order"]
    # Numbers of two bytes are the usual ones.
    channels = max(length - end, counter["byte"]) // (2 * step)
    if 1 <= channels <= _MOST_PROPOSED:
        proposed["channels"] = ", ".join(f"c{number}" for number in range(1, channels + 1))
    return proposed | fits


_MOST_PROPOSED = 8
