"""What ``daqsvc new --listen`` heard on a CAN bus, for the questions and for the file."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from daqsvc.rounding import counted
from drivers import packed_questions as packed
from drivers import questions as q
from drivers.bus_questions import Heard
from drivers.sniffing import span, usual_rate

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence

    from drivers.questions import Answers

SHOWN = 8
LAST_SHORT_ID = 0x7FF
"""Of 11 bits; a higher id has 29."""
OF_BYTES = frozenset({"channels", "raw-type", "scale"})
"""Questions about what the bytes of a frame mean, which no frame shows."""
_PLACES = {
    "first-byte": "the byte where samples begin, {} (--first-byte)",
    "byte-order": "the byte order, {} (--byte-order)",
    "samples-per-frame": "how many samples of a channel a frame has, {} (--samples-per-frame)",
}
"""Questions about where samples lie; their defaults are the usual ones."""


class HeardOnCan(Heard):
    """Frames of a CAN bus, whatever is in them.

    Attributes:
        figures: those of `drivers.can.sniff.CanSniffer`.
    """

    def __init__(self, figures: Mapping[str, Any], missed: str = "") -> None:
        super().__init__(list(in_words(figures)), missed)
        self.figures = figures

    def proposals(self, answers: Answers) -> dict[str, str]:
        """See `Heard.proposals`: the bit rates, and whether there are CAN FD frames."""
        del answers
        fd = any(one["fd"] for one in self.figures["ids"])
        rates = {"bitrate": self.figures["bitrate"], "data-bitrate": self.figures["data_bitrate"]}
        heard = {key: f"{rate}" for key, rate in rates.items() if rate is not None}
        return {"fd": "yes" if fd else "no", **heard}


class HeardFrames(HeardOnCan):
    """Frames with samples side by side."""

    def __init__(self, figures: Mapping[str, Any], channels: Callable[[Answers], Sequence[str]]) -> None:
        super().__init__(figures)
        self._channels = channels

    def proposals(self, answers: Answers) -> dict[str, str]:
        """See `Heard.proposals`."""
        proposed = super().proposals(answers)
        ids = [
            one
            for one in self.figures["ids"]
            if one["rate_hz"] and not one["remote"] and one["extended"] == (one["id"] > LAST_SHORT_ID)
        ]
        if not ids:
            return proposed
        best = max(ids, key=lambda one: (one["counter"] is not None, one["rate_hz"]))
        proposed["id"] = f"{best['id']:#x}"
        chosen = next((one for one in ids if one["id"] == answers.get("id", best["id"])), None)
        if chosen is None:
            return proposed
        length = max(chosen["lengths"])
        proposed |= packed.frame_proposals(length, chosen["counter"], answers) | {"length": f"{length}"}
        if "samples-per-frame" in answers:
            proposed["rate"] = f"{usual_rate(chosen['rate_hz'] * answers['samples-per-frame']):g}"
        return proposed

    def unheard(self, answers: Answers) -> str:
        """See `Heard.unheard`."""
        heard = [one["id"] for one in self.figures["ids"]]
        if answers.get("id", heard[0]) in heard:
            return ""
        others = ", ".join(f"{one:#x}" for one in heard[:SHOWN])
        return f"{answers['id']:#x} was not heard. Remedy: correct --id; those that come: {others}"

    def unknown(self, answers: Answers, assumed: Collection[str]) -> str:
        """See `Heard.unknown`."""
        del answers
        if not OF_BYTES.intersection(assumed):
            return ""
        heard = [line.strip() for line in _of_ids(self.figures)]
        more = len(self.figures["ids"]) - len(heard)
        return (
            f"no frame states which of its bytes are which value. Heard: {'; '.join(heard)}"
            f"{f'; and {more} more' if more else ''}. Remedy: give the DBC file of the device, with --bus "
            "can-dbc --dbc; or give --channels, --raw-type and --scale as its manual states them, or answer "
            "the questions in a terminal, without --yes; daqsvc sniff can shows the frames"
        )

    def notes(self, answers: Answers, assumed: Collection[str], taken: Collection[str]) -> Iterable[str]:
        """See `Heard.notes`: a frame shows its bytes, and not what they mean."""
        if places := self._places(answers, assumed):
            yield f"Neither heard nor answered: {'; '.join(places)}. See the device's manual."
        if "channels" in taken:
            yield f"The bytes of {answers['id']:#x} are not known: these channels are an example."

    def _places(self, answers: Answers, assumed: Collection[str]) -> list[str]:
        """What of the layout is neither heard nor answered."""
        if OF_BYTES.intersection(assumed):
            return []  # all of it is an example then
        guessed = _PLACES.keys() & set(assumed) - self.proposals(answers).keys()
        if packed.RAW_BYTES[answers["raw-type"]] == 1:
            guessed -= {"byte-order"}
        places = [_PLACES[key].format(answers[key]) for key in _PLACES if key in guessed]
        channels = self._channels(answers)
        if sensors := [one for one in channels if q.sensor_key(one, "type") in assumed]:
            places.append(f"which sensors are on {', '.join(sensors[:SHOWN])} (--sensor {sensors[0]}.type=)")
        return places


def decoded_signals(figures: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    """Messages of the DBC file whose signals were heard."""
    return [one for one in figures["dbc"]["messages"] if one["signals"]]


def values_heard(signals: Sequence[Mapping[str, Any]]) -> str:
    """The values of some signals as they were heard."""
    shown = [
        f"{one['signal']} {span(one['min'], one['max'])}{f' {unit}' if (unit := one['unit']) else ''}"
        for one in signals[:SHOWN]
    ]
    return "; ".join(shown) + (f"; and {len(signals) - SHOWN} more" if len(signals) > SHOWN else "")


def in_words(figures: Mapping[str, Any]) -> Iterator[str]:
    """What was heard, in a few lines: the ids that come most often."""
    ids = sorted(figures["ids"], key=lambda one: -(one["rate_hz"] or 0.0))
    yield f"{counted(figures['frames'], 'frame')} of {counted(len(ids), 'id')}:"
    yield from _of_ids(figures, values=True)
    if len(ids) > SHOWN:
        yield f"  ... and {len(ids) - SHOWN} more: daqsvc sniff can shows them"


def _of_ids(figures: Mapping[str, Any], *, values: bool = False) -> Iterator[str]:
    """The ids that come most often: how long their frames are, how often they come, with which values."""
    by_message = (
        {one["message"]: one for one in decoded_signals(figures)} if values and "dbc" in figures else {}
    )
    ids = sorted(figures["ids"], key=lambda one: -(one["rate_hz"] or 0.0))
    for one in ids[:SHOWN]:
        lengths = ", ".join(map(str, one["lengths"]))
        rate = "once" if one["rate_hz"] is None else f"{one['rate_hz']:.4g} a second"
        counter, message = one["counter"], one["message"]
        counts = f", byte {counter['byte']} counts" if counter else ""
        if message is None and "dbc" in figures:
            message = "not in the DBC file"
        yield f"  {one['id']:#x}: {lengths} bytes, {rate}{counts}{f', {message}' if message else ''}"
        if (heard := by_message.pop(message, None)) is None:
            continue
        yield f"    {values_heard(heard['signals'])}"
        doubts = [heard["length_doubt"], heard["rate_doubt"], *(one["doubt"] for one in heard["signals"])]
        yield from (f"    {doubt}" for doubt in doubts if doubt)
