"""What the arguments of ``daqsvc demo`` may be, each for itself and together."""

from __future__ import annotations

import argparse
import math
from typing import TYPE_CHECKING
from urllib.parse import urlsplit

if TYPE_CHECKING:
    from collections.abc import Iterable

MOST_DB = 200.0
"""Signal to noise beyond this, either way, is noise or none in double precision."""

OF_RECORDINGS = ("map", "fs", "unit", "baseline", "baseline_map", "baseline_fs", "bearing", "speed_rpm")
OF_SCENARIOS = ("scenario", "seed", "snr_db")
OF_BASELINES = ("baseline_map", "baseline_fs")


def misuse(arguments: argparse.Namespace) -> str | None:
    """What is wrong with arguments that are valid each for itself; None if nothing is."""
    if arguments.recording is None:
        if given := _given(arguments, OF_RECORDINGS):
            return f"{given} goes with a recording; give that with --recording, or leave {given} out"
    elif given := _given(arguments, OF_SCENARIOS):
        return f"{given} goes with a scenario, and --recording plays a recording; leave one of the two out"
    if arguments.baseline is None and (given := _given(arguments, OF_BASELINES)):
        return f"{given} goes with a baseline; give that with --baseline, or leave {given} out"
    if (arguments.bearing is None) != (arguments.speed_rpm is None):
        return "--bearing and --speed-rpm go together: its lines lie at multiples of the speed; give both"
    if arguments.bearing is not None and arguments.unit not in {None, "g", "m/s2"}:
        return f"--bearing needs accelerometers, and --unit is {arguments.unit}; leave one of the two out"
    return None


def _given(arguments: argparse.Namespace, names: Iterable[str]) -> str | None:
    """The first of these options that is on the command line, as it is written there."""
    return next(
        (f"--{name.replace('_', '-')}" for name in names if getattr(arguments, name) is not None), None
    )


def positive(text: str) -> float:
    """A number greater than zero."""
    value = _number(text)
    if not (math.isfinite(value) and value > 0):
        raise argparse.ArgumentTypeError(f"{text!r} is not a positive number")
    return value


def decibels(text: str) -> float:
    """A ratio of powers."""
    value = _number(text)
    if not abs(value) <= MOST_DB:
        raise argparse.ArgumentTypeError(f"{text!r} is not a number from {-MOST_DB:g} to {MOST_DB:g} dB")
    return value


def whole(text: str) -> int:
    """A whole number from 0 on."""
    if not (text.isascii() and text.isdecimal()):
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number from 0 on")
    return int(text)


def broker_url(text: str) -> str:
    """``mqtt://HOST[:PORT]``; the text is kept out of the messages where it may hold a password."""
    form = "write mqtt://HOST or mqtt://HOST:PORT"
    try:
        parts = urlsplit(text)
        port = parts.port
    except ValueError:
        raise argparse.ArgumentTypeError(f"the port must be a number from 1 to 65535; {form}") from None
    if parts.scheme in {"mqtts", "ssl", "tls"}:
        raise argparse.ArgumentTypeError(f"the demo does not speak TLS ({parts.scheme}://); {form}")
    if parts.username is not None or parts.password is not None:
        raise argparse.ArgumentTypeError(f"the demo does not log in with a user and a password; {form}")
    if parts.scheme != "mqtt" or not parts.hostname:
        raise argparse.ArgumentTypeError(f"{text!r} is not the address of a broker; {form}")
    if port == 0:
        raise argparse.ArgumentTypeError(f"the port must be a number from 1 to 65535; {form}")
    if parts.path not in {"", "/"} or parts.query or parts.fragment:
        raise argparse.ArgumentTypeError(f"{text!r} has something after host and port; {form}")
    return text


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return math.nan
