"""Numbered signals of a DBC message: samples of one channel, or separate sensors."""

from __future__ import annotations

import math
import re
from typing import TYPE_CHECKING, Any, NamedTuple

from drivers.sniffing import TYPE_OF_UNIT, plain_name, quoted

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping, Sequence

_SAMPLE = re.compile("sample|smp|abtast")
_LEAST_FRAMES = 20
"""Before, levels of the parts may differ by chance."""
_CLEARLY = 2.0
"""By this factor levels of consecutive samples of one channel do not differ."""


def samples_of_one(signals: Sequence[str]) -> dict[str, list[str]]:
    """Signals that may be samples of one channel, by its name; none if a stream cannot read them as such.

    Others may be beside them: these come once a frame, and a stream of their own reads them.
    """
    by_stem = numbered(signals)
    return by_stem if len({len(names) for names in by_stem.values()}) == 1 else {}


def beside_samples(signals: Sequence[str]) -> list[str]:
    """Signals beside those that may be samples of one channel."""
    samples = {name for names in samples_of_one(signals).values() for name in names}
    return [name for name in signals if samples and name not in samples]


class Level(NamedTuple):
    """What was heard of the values of a signal.

    Attributes:
        frames: how many there were.
        mean: of all.
        deviation: their RMS about the mean.
        resolution: what one count is worth.
    """

    frames: int
    mean: float
    deviation: float
    resolution: float


def is_named_sample(name: str) -> bool:
    """Whether the name of a signal states that it is a sample."""
    return _SAMPLE.search(plain_name(name)) is not None


def levels_apart(signals: Iterable[Any], names: Sequence[str], levels: Mapping[str, Level]) -> list[str]:
    """Those of the signals that would be samples of one channel, were their levels not clearly different.

    Args:
        signals: of the message.
        names: those that are read.
        levels: by name, of the signals that were heard.
    """
    for of_one in samples_of_one(most_likely_samples(signals, names)).values():
        heard = [levels[name] for name in of_one if name in levels]
        enough = len(heard) == len(of_one) and min(one.frames for one in heard) >= _LEAST_FRAMES
        if enough and not is_named_sample(of_one[0]) and not _are_alike(heard):
            return of_one
    return []


def _are_alike(levels: Sequence[Level]) -> bool:
    """Whether values may be of one channel: about as strong, and about the same mean."""
    least = max(one.resolution for one in levels)
    deviations = [max(one.deviation, least) for one in levels]
    strong = [max(math.hypot(one.mean, one.deviation), least) for one in levels]
    means = [one.mean for one in levels]
    return (
        max(deviations) <= _CLEARLY * min(deviations)
        and max(strong) <= _CLEARLY * min(strong)
        and max(means) - min(means) <= _CLEARLY * max(deviations)
    )


def most_likely_samples(signals: Iterable[Any], names: Sequence[str]) -> list[str]:
    """Those of the names that say so, or that count from 0 and are of vibration: a guess."""
    units = unit_names(signals, names)
    by_stem = {
        stem: of_one
        for stem, of_one in numbered(names).items()
        if is_named_sample(of_one[0])
        or (number_of(of_one[0]) == 0 and all(units.get(name) in TYPE_OF_UNIT for name in of_one))
    }
    return [name for name in names if any(name in of_one for of_one in by_stem.values())]


def unit_names(signals: Iterable[Any], names: Iterable[str]) -> dict[str, str]:
    """Units of the signals of these names, as far as they are known, as machine files write them.

    Those of peak values are not among them: what is known of ``mm/s`` is not so of ``mm/s pk``.
    """
    from daqsvc.settings.units import is_of_peak, unit_of  # noqa: PLC0415 - brings the settings

    chosen = set(names)
    stated = {one.name: one.unit or "" for one in signals if one.name in chosen}
    known = {name: unit_of(text) for name, text in stated.items() if not is_of_peak(text)}
    return {name: unit.name for name, unit in known.items() if unit is not None}


def numbered(signals: Sequence[str]) -> dict[str, list[str]]:
    """Signals whose names differ in a last 0, 1 and so on only, or 1, 2, by what they have in common."""
    stems: dict[str, list[str]] = {}
    for name in signals:
        if match := re.fullmatch(r"(.*[^0-9_])_?(\d+)", name):
            stems.setdefault(match[1], []).append(name)
    return {stem: names for stem, names in stems.items() if len(names) > 1 and _in_a_row(names)}


def _in_a_row(names: Sequence[str]) -> bool:
    first, *_ = numbers = [number_of(name) for name in names]
    return first < 2 and numbers == list(range(first, first + len(numbers)))


def number_of(name: str) -> int:
    """The number that a name ends in."""
    return int(re.sub(r".*[^0-9]", "", name))


def of_one_channel(signals: Sequence[str]) -> Iterator[str]:
    """A comment on signals that may be samples of one channel in a frame."""
    for stem, of_one in numbered(signals).items():
        channel = f"{{ name = {quoted(stem)}, signals = [{', '.join(map(quoted, of_one))}] }}"
        yield f"# If these are samples of one channel: {channel}, and {len(of_one)} times the rate."


def of_separate_sensors(samples: Mapping[str, Sequence[str]]) -> Iterator[str]:
    """A comment on signals that were taken for samples of one channel."""
    for of_one in samples.values():
        channel = f"{{ name = {quoted(of_one[0])}, signals = [{quoted(of_one[0])}] }}"
        yield f"# If these are separate sensors: {channel} and so on, and the rate divided by {len(of_one)}."
