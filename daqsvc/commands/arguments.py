"""What all verbs of the command line share: parser, exit codes, values of options, signals that end one.

What is wrong is reported in one line, the usage only where it is asked for.
"""

from __future__ import annotations

import argparse
import math
import re
import signal
from dataclasses import dataclass
from decimal import Decimal
from difflib import get_close_matches
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

from daqsvc.confined.limits import GIGABYTE
from daqsvc.errors.code import with_code
from daqsvc.errors.command_line import ARGUMENTS, WRONG_VALUE
from daqsvc.recording.rate import LEAST_RATE_HZ, MOST_RATE_HZ

if TYPE_CHECKING:
    from collections.abc import Callable

    from daqsvc.errors.code import Code

EXIT_OK = 0
EXIT_FAILED = 1
EXIT_USAGE = 2
"""Wrong arguments, or a machine file that cannot be used."""
EXIT_REFUSED = 3
"""Of `analyze`, `calibrate` and `export`: a recording cannot be judged, or read."""
EXIT_LOST = 3
"""Of `run`: something without which the service is useless was lost while it ran."""
EXIT_HUNG = 4
"""Of `run`: something hung while the service stopped."""
EXIT_STUCK = 5
"""Of `run`: the event loop was blocked."""


_FILE_AND_STORE = (
    {"argument --store:", "argument FILE"},
    {"argument FILE:", "argument --store"},
)
"""Parts of the message of argparse that both name a store, in either order."""
_ALIKE = 0.7
"""How alike a word and a choice are that may be meant, as `difflib` counts it."""


class ArgumentParser(argparse.ArgumentParser):
    """A parser whose errors are one line; so are those of its verbs."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        # "-5m" is a wrong value, not an unknown option.
        self._negative_number_matcher = re.compile(r"-\.?\d")
        # An empty path, as of a variable that is not set, would be the working directory.
        self.register("type", Path, path)

    def _check_value(self, action: argparse.Action, value: Any) -> None:
        """See `argparse.ArgumentParser`; the choice that may be meant comes before all others."""
        try:
            super()._check_value(action, value)
        except argparse.ArgumentError as error:
            near = get_close_matches(str(value), map(str, action.choices or ()), n=1, cutoff=_ALIKE)
            if near:
                error.message = error.message.replace(" (choose", f"; did you mean {near[0]!r}? (choose", 1)
            raise

    def error(self, message: str) -> NoReturn:
        """Say what is wrong and where help is, and exit with 2."""
        is_value = message.startswith("argument ") and "not allowed with argument" not in message
        if set(message.split(" not allowed with ")) in _FILE_AND_STORE:
            message += "; the machine file names the store already: leave out FILE or --store"
        code = WRONG_VALUE if is_value else ARGUMENTS
        self.exit(EXIT_USAGE, with_code(f"{self.prog}: {message}; see {self.prog} --help", code) + "\n")


def refuse_value(parser: argparse.ArgumentParser, error: object, code: Code) -> NoReturn:
    """Say what is wrong with a value or a file that was named, and exit with 2."""
    parser.exit(EXIT_USAGE, with_code(f"{parser.prog}: {error}", code) + "\n")


def add_overwrite(parser: argparse.ArgumentParser) -> None:
    """The option of verbs that write a file, which replaces one that is there; it was called ``--force``."""
    parser.add_argument(
        "--overwrite",
        "--force",
        dest="overwrite",
        action="store_true",
        help="replace the file if it exists; --force is its former name",
    )


def path(text: str) -> Path:
    """A file or directory; what ``type=Path`` of an argument means here."""
    if not text:
        raise argparse.ArgumentTypeError("must not be empty")
    return Path(text)


def signals_to_end() -> tuple[signal.Signals, ...]:
    """SIGTERM, SIGINT, and SIGHUP of a terminal that goes, unless the verb is to outlive that (nohup)."""
    if signal.getsignal(signal.SIGHUP) is signal.SIG_IGN:
        return (signal.SIGTERM, signal.SIGINT)
    return (signal.SIGTERM, signal.SIGINT, signal.SIGHUP)


_ORBIT = "orbit:"
_UNITS_S = {"s": 1, "m": 60, "h": 3600, "d": 86_400}
_PART = re.compile(r"([0-9]{1,9})([smhd])")
_DURATION = re.compile(r"([0-9]{1,9}d)?([0-9]{1,9}h)?([0-9]{1,9}m)?([0-9]{1,9}s)?")

LEAST_MEMORY_GB = 0.05
MOST_MEMORY_GB = 1000.0

LONGEST_S = 366 * 86_400
"""Longest time that a duration can state."""


@dataclass(frozen=True, slots=True)
class SpeedOption:
    """What ``--speed-rpm`` states.

    Attributes:
        rpm: the speed, negative if clockwise.
        orbit: whether the orbit's own 1X is followed about it.
        step_rpm: the step of its last digit: 5111 is not 5111.000.
    """

    rpm: float | None
    orbit: bool = False
    step_rpm: float = 0.0


def probe_pair(text: str) -> tuple[str, str]:
    """``X,Y``: two channels."""
    names = tuple(name.strip() for name in text.split(","))
    if len(names) != 2 or not all(names) or names[0] == names[1]:
        raise argparse.ArgumentTypeError(f"{text!r} does not name two probes; write X,Y")
    return names[0], names[1]


def speed(text: str) -> SpeedOption:
    """``N``, ``-N`` or ``orbit:N``."""
    orbit = text.startswith(_ORBIT)
    value = _float(text.removeprefix(_ORBIT))
    if not math.isfinite(value) or not 0.0 < abs(value) <= 1e6:
        raise argparse.ArgumentTypeError(
            f"{text!r} is not a speed; write revolutions per minute, negative if clockwise, or orbit:N"
        )
    exponent = Decimal(text.removeprefix(_ORBIT)).as_tuple().exponent
    return SpeedOption(value, orbit, step_rpm=10.0**exponent if isinstance(exponent, int) else 0.0)


def number(text: str) -> float:
    """A finite number."""
    value = _float(text)
    if not math.isfinite(value):
        raise argparse.ArgumentTypeError(f"{text!r} is not a finite number")
    return value


def positive(text: str) -> float:
    """A finite number above 0."""
    value = _float(text)
    if not (math.isfinite(value) and value > 0.0):
        raise argparse.ArgumentTypeError(f"{text!r} is not a number above 0")
    return value


def not_negative(text: str) -> float:
    """A finite number from 0 on."""
    value = _float(text)
    if not (math.isfinite(value) and value >= 0.0):
        raise argparse.ArgumentTypeError(f"{text!r} is not a number from 0 on")
    return value


def percent(text: str) -> float:
    """A part in percent, from 0 to below 100."""
    value = _float(text)
    if not 0.0 <= value < 100.0:
        raise argparse.ArgumentTypeError(f"{text!r} is not a percentage from 0 to below 100")
    return value


def count(text: str) -> int:
    """A whole number from 1 on."""
    value = _whole(text)
    if value < 1:
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number from 1 on")
    return value


def duration(text: str) -> float:
    """A time in seconds, written like ``90s``, ``30m``, ``8h``, ``2d`` or ``1h30m``."""
    if not _DURATION.fullmatch(text):
        raise argparse.ArgumentTypeError(f"{text!r} is not a time; write e.g. 90s, 30m, 8h, 2d or 1h30m")
    total_s = sum(int(number) * _UNITS_S[unit] for number, unit in _PART.findall(text))
    if not 0 < total_s <= LONGEST_S:
        raise argparse.ArgumentTypeError(f"{text!r} is not a time from 1s to {LONGEST_S // 86_400}d")
    return float(total_s)


def one_line(text: str) -> str:
    """Text that can be written in a log."""
    if not text.isprintable():
        raise argparse.ArgumentTypeError(f"{text!r} is not printable; write one line of plain text")
    return text


def alarm_id(text: str) -> str:
    """Name of an alarm, or the beginning of an id."""
    if not text.strip():
        raise argparse.ArgumentTypeError(
            f"{text!r} names no alarm; write its name, or how its id begins in daqsvc alarms"
        )
    return text


def is_path(word: str) -> bool:
    """Whether a word among alarms is a machine file, or a folder of them.

    It is if it ends with ``.toml`` or begins as no name does, or if there is a file or folder of this name.
    """
    if word.endswith(".toml") or word.startswith(("/", "./", "../", "~")):
        return True
    try:
        return Path(word).exists()
    except OSError:
        return False  # too long, for instance


def channel_names(text: str) -> tuple[str, ...]:
    """``NAME,...``: one or more channels."""
    names = tuple(name.strip() for name in text.split(","))
    if not all(names) or len(set(names)) < len(names):
        raise argparse.ArgumentTypeError(f"{text!r} does not name channels; write NAME,NAME, each once")
    return names


def channel_map(text: str) -> dict[str, str]:
    """``NAME=VARIABLE,...``: what each channel is called from now on, and in the file."""
    pairs = [pair.partition("=") for pair in text.split(",")]
    columns: dict[str, str] = {}
    for name, _, variable in pairs:
        if not (name.strip() and variable.strip()):
            raise argparse.ArgumentTypeError(
                f"{text!r} is not a map; write NAME=VARIABLE, several with commas between"
            )
        if name.strip() in columns:
            raise argparse.ArgumentTypeError(
                f"{text!r} names {name.strip()!r} twice; give each channel its own name"
            )
        columns[name.strip()] = variable.strip()
    return columns


def sampling_rate_hz(text: str) -> float:
    """A sampling rate that a recording may have."""
    what = f"a sampling rate from {LEAST_RATE_HZ:g} to {MOST_RATE_HZ:,.0f} Hz"
    return _between(text, LEAST_RATE_HZ, MOST_RATE_HZ, what)


def probability(text: str) -> float:
    """A false-alarm probability."""
    return _between(text, 1e-9, 0.5, "a probability from 1e-9 to 0.5")


def memory_limit(text: str) -> int:
    """Memory in GB that reading a recording may take, in bytes."""
    what = f"a number of GB from {LEAST_MEMORY_GB:g} to {MOST_MEMORY_GB:g}"
    return round(_between(text, LEAST_MEMORY_GB, MOST_MEMORY_GB, what) * GIGABYTE)


def add_max_memory(add: Callable[..., argparse.Action]) -> None:
    """The option ``--max-memory``; what it reports goes to `daqsvc.recording.recording.set_memory`.

    Args:
        add: ``add_argument`` of the group that takes it.
    """
    add(
        "--max-memory",
        type=memory_limit,
        metavar="GB",
        help="memory for reading one recording, in GB (default: half of this computer's, at most 4)",
    )


def calibration_length(text: str) -> int:
    """Revolutions that make a baseline."""
    from daqsvc.rotor.synchronous.baseline import LEAST_REVOLUTIONS  # noqa: PLC0415 - brings NumPy

    value = _whole(text)
    if not LEAST_REVOLUTIONS <= value <= 100_000:
        raise argparse.ArgumentTypeError(
            f"{text!r} revolutions do not make a baseline; "
            f"give a whole number from {LEAST_REVOLUTIONS} to 100000"
        )
    return value


def _between(text: str, least: float, most: float, what: str) -> float:
    value = _float(text)
    if not least <= value <= most:
        raise argparse.ArgumentTypeError(f"{text!r} is not {what}")
    return value


def _float(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return math.nan


def _whole(text: str) -> int:
    try:
        return int(text)
    except ValueError:
        return -1
