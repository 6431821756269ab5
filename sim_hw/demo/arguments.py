"""What the arguments of ``daqsvc demo`` may be, each for itself and together."""

from __future__ import annotations

import argparse
from urllib.parse import urlsplit

from sim_hw.arguments import given, misplaced

OF_RECORDINGS = (
    "map",
    "fs",
    "max_memory",
    "unit",
    "baseline",
    "baseline_map",
    "baseline_fs",
    "bearing",
    "speed_rpm",
)
OF_SCENARIOS = ("scenario", "seed", "snr_db")
OF_BASELINES = ("baseline_map", "baseline_fs")


def misuse(arguments: argparse.Namespace) -> str | None:
    """What is wrong with arguments that are valid each for itself; None if nothing is."""
    if wrong := misplaced(arguments, OF_RECORDINGS, OF_SCENARIOS):
        return wrong
    if arguments.baseline is None and (option := given(arguments, OF_BASELINES)):
        return f"{option} goes with a baseline; give that with --baseline, or leave {option} out"
    if (arguments.bearing is None) != (arguments.speed_rpm is None):
        return "--bearing and --speed-rpm go together: its lines lie at multiples of the speed; give both"
    if arguments.bearing is not None and arguments.unit not in {None, "g", "m/s2"}:
        return f"--bearing needs accelerometers, and --unit is {arguments.unit}; leave one of the two out"
    return None


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
