"""What ``daqsvc new --listen`` heard of the messages of a DBC file, for the questions and for the file."""

from __future__ import annotations

import shlex
from typing import TYPE_CHECKING, Any

from drivers.can.dbc_likely import likely_counter, likely_measured
from drivers.can.heard import SHOWN, HeardOnCan, decoded_signals, values_heard
from drivers.can.numbered import (
    Level,
    beside_samples,
    is_named_sample,
    levels_apart,
    numbered,
    samples_of_one,
)
from drivers.can.other_source import other_sources
from drivers.can.sniff import CLOCK, STATE, of_another_stream
from drivers.questions import NONE, Answers, sensor_key
from drivers.sniffing import usual_rate

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterable, Mapping, Sequence

    from cantools.database.can import Message


class HeardMessages(HeardOnCan):
    """Frames that a DBC file describes, or should."""

    def __init__(
        self,
        figures: Mapping[str, Any],
        dbc: str,
        messages: Mapping[str, Message],
        samples_in_frame: Callable[[Answers], int],
        types: Callable[[Answers, Mapping[str, Mapping[str, Any]]], Mapping[str, str]],
        *,
        rate_is_stated: bool,
    ) -> None:
        self._decoded = decoded_signals(figures)
        strangers = [one["id"] for one in figures["ids"] if one["message"] is None and one.get("extended")]
        silent = set(messages) - {one["message"] for one in figures["ids"]}
        extended = {name: messages[name].frame_id for name in silent if messages[name].is_extended_frame}
        self._other_sources = list(other_sources(strangers, extended))
        missed = ". ".join(self._other_sources) or (
            f"No frame is as {dbc} describes: it is most likely the file of another device. Remedy: give the "
            "file of the device that sends"
        )
        super().__init__(figures, "" if self._decoded else missed)
        self._rate_is_stated = rate_is_stated
        self._messages, self._samples_in_frame, self._types = messages, samples_in_frame, types

    def proposals(self, answers: Answers) -> dict[str, str]:
        """See `Heard.proposals`."""
        proposed, heard = super().proposals(answers), self._decoded
        if not heard:
            return proposed

        def score(message: Mapping[str, Any]) -> tuple[bool, bool, int]:
            signals = message["signals"]
            counted = any(one["counts_frames"] for one in signals)
            return counted, any(one["unit"] for one in signals), message["frames"]

        best = max(heard, key=score)
        proposed["message"] = best["message"]
        chosen = next((m for m in heard if m["message"] == answers.get("message", best["message"])), None)
        if chosen is None:
            return proposed
        counters = [one["signal"] for one in chosen["signals"] if one["counts_frames"]]
        if any(one["multiplexed"] for one in chosen["signals"]):
            # Most signals that count do so on all pages, and a stream reads the frames of one.
            likely = likely_counter(self._messages[chosen["message"]])
            counters = [one for one in counters if one == likely]
        sampled = self._counting_samples(chosen["signals"])
        proposed["counter"] = next(iter([*counters, *sampled]), NONE)
        if "signals" in answers and answers.get("counter") in sampled:
            together = samples_of_one(answers["signals"]).values()
            fits = {len(names) for names in together} == {sampled[answers["counter"]]}
            proposed["consecutive"] = "yes" if fits else "no"
            counts = "samples" if self._samples_in_frame(answers) == sampled[answers["counter"]] else "frames"
            proposed["counter-counts"] = counts
        elif "signals" in answers and self._apart(answers):
            proposed["consecutive"] = "no"
        if signals := self._without_clocks(answers | {"message": chosen["message"]}):
            proposed["signals"] = ", ".join(signals)
        rates = [one["rate_hz"] for one in self.figures["ids"] if one["message"] == chosen["message"]]
        if len(rates) == 1 and rates[0]:
            measured = [one for one in chosen["signals"] if one["signal"] in answers.get("signals", ())]
            share = _simple_share(
                min((one["frames"] for one in measured), default=chosen["frames"]), chosen["frames"]
            )
            in_frame = self._samples_in_frame(answers) if "signals" in answers else 1
            proposed["rate"] = f"{usual_rate(rates[0]) * share * in_frame:g}"
        if "rate" in answers:
            guessed = self._types(answers, {})
            types = self._types(answers, {one["signal"]: one for one in chosen["signals"]})
            changed = {one: kind for one, kind in types.items() if kind != guessed[one]}
            proposed |= {sensor_key(channel, "type"): kind for channel, kind in changed.items()}
        return proposed

    def _clocks(self, answers: Answers) -> list[str]:
        """Signals that rose all the time, as a clock does, and are no quantity by their unit."""
        from daqsvc.settings.units import unit_of  # noqa: PLC0415 - brings the settings

        heard = [one for one in self._signals(answers) if one["rises"] or one["step"]]
        rising = [one for one in heard if not one["counts_frames"]]
        units = {one["signal"]: unit_of(one["unit"]) for one in rising}
        # A speed or a temperature may rise for as long as it is listened to.
        return [name for name, unit in units.items() if unit is None or unit.quantity == "time"]

    def _without_clocks(self, answers: Answers) -> list[str]:
        """What is measured by the DBC file, as far as what was heard shows that; empty if it shows nothing.

        A clock is left out, and what is beside numbered signals is read, too, if they are separate sensors.
        """
        clocks = {*self._clocks(answers), answers.get("counter")}
        apart = bool(self._apart(answers))
        if clocks <= {answers.get("counter")} and not apart:
            return []
        signals = self._messages[answers["message"]].signals
        return likely_measured([one for one in signals if one.name not in clocks], apart=apart)

    def _apart(self, answers: Answers) -> list[str]:
        """Signals that are numbered like samples of one channel, and have clearly different levels."""
        heard = self._signals(answers)
        if answers.get("counter", "") in self._counting_samples(heard):
            return []
        signals = self._messages[answers["message"]].signals
        counts = {one.name: abs(float(one.scale)) for one in signals}
        levels = {
            one["signal"]: Level(one["frames"], one["mean"], one["deviation"], counts[one["signal"]])
            for one in heard
        }
        return levels_apart(signals, answers.get("signals") or [*levels], levels)

    def unheard(self, answers: Answers) -> str:
        """See `Heard.unheard`."""
        heard = [one["message"] for one in self._decoded]
        chosen = answers.get("message", "")
        if not heard or not chosen:
            return ""
        if chosen in heard:
            return self._other_length(answers) or self._other_counter(answers)
        return (
            f"{answers['message']} was not heard. Remedy: correct --message; those that come: "
            f"{', '.join(heard)}"
        )

    def _other_length(self, answers: Answers) -> str:
        """That the frames of the message have another length than the file states; empty if not."""
        message = answers["message"]
        one = self._message(answers)
        if one["length_doubt"]:
            return f"{one['length_doubt']} Remedy: give the file of the device that sends"
        return self._shorter(message)

    def _shorter(self, message: str) -> str:
        length = self._messages[message].length
        lengths = {
            many for one in self.figures["ids"] if one["message"] == message for many in one["lengths"]
        }
        if not lengths or max(lengths) >= length:
            return ""
        come = " and ".join(f"{many}" for many in sorted(lengths))
        return (
            f"the frames of {message} have {come} bytes, the DBC file states {length}. Remedy: give the file "
            "of the device that sends"
        )

    def _other_counter(self, answers: Answers) -> str:
        """That the signal which is to count the frames was heard and does not; empty if it may."""
        counter, sampled = answers.get("counter"), self._counting_samples(self._signals(answers))
        if counter in sampled and "rate" in answers and self._samples_in_frame(answers) != sampled[counter]:
            return (
                f"{counter} grows by {sampled[counter]} from frame to frame, as what counts samples does. "
                f"Remedy: --consecutive yes, if {sampled[counter]} numbered signals are samples of one "
                "channel; else --counter none"
            )
        if counter not in self._not_counting(answers):
            return ""
        counters = [one for one in self._signals(answers) if one["counts_frames"]]
        instead = ", ".join([*(one["signal"] for one in counters), NONE])
        step = next(one["step"] for one in self._signals(answers) if one["signal"] == counter)
        grows = "does not grow by 1" if step is None else f"grows by {step:,} and not by 1"
        return f"{counter} {grows} from frame to frame. Remedy: correct --counter; it may be {instead}"

    @staticmethod
    def _counting_samples(signals: Sequence[Mapping[str, Any]]) -> dict[str, int]:
        """Signals that grow by as many as there are numbered signals of one channel, and by how much."""
        many = {len(names) for names in numbered([one["signal"] for one in signals]).values()}
        return {
            one["signal"]: one["step"] for one in signals if one["step"] in many and not one["multiplexed"]
        }

    def _message(self, answers: Answers) -> Mapping[str, Any]:
        """The message as it was heard; without signals if it was not."""
        chosen = (one for one in self._decoded if one["message"] == answers.get("message"))
        return next(chosen, {"signals": [], "length_doubt": "", "rate_doubt": ""})

    def _signals(self, answers: Answers) -> list[Mapping[str, Any]]:
        """The signals of the message as they were heard."""
        return list(self._message(answers)["signals"])

    def _not_counting(self, answers: Answers) -> set[str]:
        """Signals of the message that do not grow by 1 from frame to frame of those that a stream reads."""
        from drivers.counter_search import LEAST_COUNTS  # noqa: PLC0415 - brings numpy

        signals = self._signals(answers)
        paged = any(one["multiplexed"] for one in signals)
        sampled = self._counting_samples(signals)
        # A counter of each page by itself has the same value in several frames in a row.
        return {
            one["signal"]
            for one in signals
            if not one["counts_frames"]
            and one["signal"] not in sampled
            and one["frames"] > LEAST_COUNTS
            and (one["multiplexed"] or not paged)
        }

    def not_offered(self, answers: Answers) -> Mapping[str, Collection[str]]:
        """See `Heard.not_offered`."""
        return {"counter": self._not_counting(answers)}

    def notes(self, answers: Answers, assumed: Collection[str], taken: Collection[str]) -> Iterable[str]:
        """See `Heard.notes`: what was heard of the channels, so that a person can judge it."""
        del assumed
        heard = {one["signal"]: one for one in self._signals(answers)}
        left_out = beside_samples(answers["signals"]) if answers.get("consecutive") else []
        read = [heard[name] for name in answers["signals"] if name in heard and name not in left_out]
        message = self._message(answers)
        notes = [message["length_doubt"]] if message["length_doubt"] else []
        notes += [f"Heard: {values_heard(read)}."] if read and not notes else []
        notes += [message["rate_doubt"]] if message["rate_doubt"] else []
        if silent := [name for name in answers["signals"] if name not in heard]:
            notes.append(f"No value was heard of {', '.join(silent[:SHOWN])}.")
        notes += _doubts(one for message in self._decoded for one in message["signals"])
        if "consecutive" in taken and answers["consecutive"] and answers.get("counter-counts") != "samples":
            notes += [
                f"{names[0]} to {names[-1]} are read as {len(names)} samples of {channel}: a guess by their "
                "names. If they are separate sensors, give --consecutive no."
                for channel, names in samples_of_one(answers["signals"]).items()
                if not is_named_sample(channel)
            ]
        if "consecutive" in taken and (apart := self._apart(answers)):
            levels = ", ".join(f"{heard[name]['deviation']:.3g}" for name in apart)
            notes.append(
                f"{apart[0]} to {apart[-1]} are read as {len(apart)} channels, as their levels differ "
                f"(standard deviations {levels})."
            )
        elif "consecutive" in taken and not answers["consecutive"]:
            notes += [
                f"{names[0]} to {names[-1]} are read as {len(names)} channels: nothing shows whether they "
                f"are {len(names)} samples of one. If they are, give --consecutive yes."
                for names in samples_of_one(answers["signals"]).values()
                if all(answers.get(sensor_key(name, "type")) != "trend" for name in names)
            ]
        sampled = self._counting_samples([*heard.values()])
        if (
            answers["counter"] is None
            and not sampled
            and not any(one["counts_frames"] for one in heard.values())
        ):
            offered = likely_counter(self._messages[answers["message"]])
            few = offered is not None and offered not in self._not_counting(answers)
            notes.append(
                (
                    f"Too few frames of {answers['message']} came to see whether {offered} counts them: "
                    f"without --counter {offered} lost ones are found by the times of arrival only."
                )
                if few
                else (
                    f"No signal is known to count the frames of {answers['message']}: lost ones are found by "
                    "the times of arrival only."
                )
            )
        counter = heard.get(answers["counter"])
        counted = {1, self._samples_in_frame(answers)}
        if counter is not None and counter["step"] not in counted:
            notes.append(f"It was not heard whether {counter['signal']} counts the frames that are read.")
        return notes

    def unknown(self, answers: Answers, assumed: Collection[str]) -> str:
        """See `Heard.unknown`: values that contradict the file make it most likely that of another device."""
        if "signals" not in answers:
            return ""
        if (doubt := self._message(answers)["rate_doubt"]) and not self._rate_is_stated:
            return (
                f"{doubt} Remedy: give each device its own id, or watch one of them alone. If one "
                "device sends so often, state its rate with --rate"
            )
        named = None if "signals" in assumed else answers["signals"]
        read = [one for one in self._signals(answers) if named is None or one["signal"] in named]
        if not (doubts := _doubts(read)):
            return ""
        return (
            f"{' '.join(doubts)} Remedy: give the file of the device that sends. If it is that one, name "
            "with --signals those that are right, or answer the questions in a terminal, without --yes"
        )

    def not_read(self, answers: Answers) -> Iterable[str]:
        """See `Heard.not_read`: the file reads one message, and of that no states if nobody names them."""
        others = [
            f"{one['message']} ({one['id']:#x})"
            for one in self.figures["ids"]
            if one["message"] not in {None, answers["message"]}
        ]
        if others:
            yield (
                f"Not read: {_few(others)}; {_sniffed_by(answers)} prints their tables. Of these take the "
                "streams and sensors: they are on the same bus."
            )
        left_out = beside_samples(answers["signals"]) if answers.get("consecutive") else []
        if left_out:
            in_frame = self._samples_in_frame(answers)
            yield f"Not read: {_few(left_out)}. Each {of_another_stream(in_frame)}."
        yield from (f"Not read: {words}." for words in self._other_sources)
        taken = {answers["counter"], *answers["signals"]}
        signals = self._messages[answers["message"]].signals
        states = [one.name for one in signals if one.choices and one.name not in taken]
        yield from (f"{name} is left out: {STATE}." for name in states[:SHOWN])
        clocks = [name for name in self._clocks(answers) if name not in taken]
        yield from (f"{name} is left out: {CLOCK}." for name in clocks[:SHOWN])
        heard = [one["signal"] for one in self._signals(answers)]
        if rest := [name for name in heard if name not in {*taken, *states, *clocks}]:
            yield (
                f"Not read of {answers['message']}: {_few(rest)}. Name with --signals what of them is "
                "measured."
            )


def _few(names: Sequence[str]) -> str:
    more = f" and {len(names) - SHOWN} more" if len(names) > SHOWN else ""
    return f"{', '.join(names[:SHOWN])}{more}"


def _sniffed_by(answers: Answers) -> str:
    """The command that looks at the same bus with the same DBC file."""
    adapter = [] if answers["interface"] == "socketcan" else ["--interface", answers["interface"]]
    adapter += ["--fd"] if adapter and answers["fd"] else []
    return shlex.join(["daqsvc", "sniff", "can", answers["channel"], *adapter, "--dbc", answers["dbc"]])


def _doubts(signals: Iterable[Mapping[str, Any]]) -> list[str]:
    """What of the values that were heard contradicts the DBC file."""
    return [one["doubt"] for one in signals if one["doubt"]][:SHOWN]


def _simple_share(frames: int, of_all: int) -> float:
    """The simplest fraction that so many of all frames can be: of a short time, one frame more or less."""
    for pages in range(1, of_all):
        taken = max(round(frames / of_all * pages), 1)
        if abs(frames - of_all * taken / pages) <= 1.0:
            return taken / pages
    return frames / of_all
