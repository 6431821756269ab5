"""``daqsvc sniff serial``: which baud rate a device has, and what it sends."""

from __future__ import annotations

import errno
import os
import select
import time
from collections import deque
from functools import partial
from typing import TYPE_CHECKING, Any

from daqsvc.rounding import counted
from drivers.serial.ports import serial_ports
from drivers.serial.sniff_report import LEAST_TEXT, WAITING_S, Heard, Report, Tried, all_alike, too_few
from drivers.sniffing import (
    Sniffed,
    Sniffer,
    SniffError,
)

if TYPE_CHECKING:
    import argparse
    import threading
    from collections.abc import Callable, Sequence


BAUDS = (115_200, 9600, 19_200, 57_600, 38_400, 230_400, 460_800, 921_600, 4800, 2400, 1200)
"""Tried in this order, until one is beyond doubt."""
TRY_S = 1.0
TRY_BYTES = 512
"""Bytes that are enough to judge a rate."""
AGAIN_S = 3.0
"""For which a rate is tried again where too little came to judge it."""
SECONDS = 5.0
LONGEST_SECONDS = 3600.0
LONGER_S = 20.0
"""For which it goes on by itself where something comes, and too little to judge."""
LITTLE_BYTES, _LITTLE_LINES = 256, 10
"""Bytes and lines from which on it is enough."""
MOST_KEPT = 1 << 20
"""Bytes that are kept of what comes."""
_POLL_MS = 100
_READ = 65_536


class SerialSniffer(Sniffer):
    """See `drivers.sniffing.Sniffer`.

    Args:
        seconds: time to listen, unless it is stated by ``--seconds``.
    """

    help = "listen to a serial port: baud rate, first bytes, columns of lines or frames"
    description = (
        "Listen to a serial port: try the usual baud rates, print the first bytes, and find whether "
        "they are lines of text or binary frames. Also print columns, sync word, length, CRC and "
        "counter. Nothing is sent."
    )

    def __init__(self, seconds: float = SECONDS) -> None:
        self._seconds = seconds

    def add_arguments(self, parser: argparse.ArgumentParser) -> None:
        """See `drivers.sniffing.Sniffer.add_arguments`."""
        parser.add_argument("port", metavar="PORT", help="path of the port, e.g. /dev/ttyUSB0")
        parser.add_argument(
            "--baud", type=int, metavar="BIT/S", help="baud rate of the port (default: try the usual ones)"
        )
        parser.add_argument(
            "--seconds",
            type=float,
            metavar="S",
            help=f"time to listen, in s, after the baud rate is found (default: {SECONDS:g}, and up to "
            f"{LONGER_S:g} more if little comes)",
        )

    def sniff(
        self, arguments: argparse.Namespace, stop: threading.Event, tell: Callable[[str], None]
    ) -> Sniffed:
        """See `drivers.sniffing.Sniffer.sniff`."""
        seconds = self._seconds if arguments.seconds is None else arguments.seconds
        if not 0 < seconds <= LONGEST_SECONDS:
            wrong = f"--seconds {seconds:g}: give a time above 0, up to {LONGEST_SECONDS:g} s"
            raise SniffError(wrong, usage=True)
        if arguments.baud is not None and not 50 <= arguments.baud <= 12_000_000:
            wrong = f"--baud {arguments.baud}: give a rate from 50 to 12000000 bit/s"
            raise SniffError(wrong, usage=True)
        bauds = BAUDS if arguments.baud is None else (arguments.baud,)
        tried = _try_all(arguments.port, bauds, stop, tell) if arguments.baud is None else []
        if _is_unclear(tried):
            tried = _try_again(arguments.port, tried, arguments.seconds, stop, tell)
        best = _likeliest(tried)
        # By bytes that are none of the device's, nothing can be known, however many they are.
        in_vain = best is not None and (_is_unclear(tried) or not any(one.heard.received for one in tried))
        if (best is None or not (in_vain or best.heard.lost)) and not stop.is_set():
            baud, parity = (bauds[0], "none") if best is None else (best.baud, best.parity)
            tell(f"listening to {arguments.port} at {baud} bit/s for {seconds:g} s; Ctrl-C ends it")
            longer = None
            if arguments.seconds is None:
                came = any(one.heard.received for one in tried)
                longer = partial(_go_on, arguments.port, seconds, tell, came=came)
            best = _try(arguments.port, baud, parity, seconds, MOST_KEPT, stop, longer)
        if best is None:
            raise SniffError(f"{arguments.port}: it was ended before a byte came")
        return Report(arguments.port, tried, best, arguments.baud is not None).sniffed()


def _try_all(
    port: str, bauds: Sequence[int], stop: threading.Event, tell: Callable[[str], None]
) -> list[Tried]:
    """The baud rates until one is beyond doubt; with parity where none was without."""
    from drivers.serial.recognise import CONCLUSIVE  # noqa: PLC0415 - only for who listens

    tried: list[Tried] = []
    for parity in ("none", "even"):
        for baud in bauds:
            if stop.is_set():
                return tried
            tell(f"trying {port} at {baud} bit/s{'' if parity == 'none' else f', {parity} parity'}")
            tried.append(one := _try(port, baud, parity, TRY_S, TRY_BYTES, stop))
            if one.recognised.score >= CONCLUSIVE or one.heard.lost:
                return tried
        if not any(one.heard.errors for one in tried):
            break  # parity that is not expected shows as missing stop bits
    return tried


def _is_unclear(tried: Sequence[Tried]) -> bool:
    """Whether little came at all rates, and at none of them what may be text."""
    came = any(one.heard.received for one in tried)
    lost = any(one.heard.lost for one in tried)
    return came and not lost and too_few(tried) and not any(one.may_be_text for one in tried)


def _likeliest(tried: Sequence[Tried]) -> Tried | None:
    """The rate to listen at; None if none was tried."""
    if all_alike(tried):
        return tried[0]
    texts = [one for one in tried if one.may_be_text] if too_few(tried) else []
    return max(texts or tried, key=lambda one: (one.recognised.score, one.heard.received), default=None)


def _try_again(
    port: str,
    tried: Sequence[Tried],
    seconds: float | None,
    stop: threading.Event,
    tell: Callable[[str], None],
) -> list[Tried]:
    """The rates at which too little came, each for longer, until what comes may be text."""
    each_s = AGAIN_S if seconds is None else max(seconds, TRY_S)
    # What came at the others is no text, whatever follows; but frames need more bytes.
    again = [at for at, one in enumerate(tried) if seconds is not None or one.heard.received < LEAST_TEXT]
    if again:
        tell(
            f"too few bytes came from {port} to judge the baud rate: trying {counted(len(again), 'rate')} "
            f"again, for {each_s:g} s each; --seconds sets the time, --baud the rate"
        )
    result = list(tried)
    for at in again:
        if stop.is_set():
            break
        one = tried[at]
        result[at] = new = _try(port, one.baud, one.parity, each_s, TRY_BYTES, stop)
        if new.may_be_text or new.recognised.sure or new.heard.lost:
            break
    return result


def _go_on(port: str, seconds: float, tell: Callable[[str], None], data: bytes, *, came: bool) -> bool:
    """Whether to listen longer, as something comes and it is too little to judge; it then states that."""
    if not (data or came) or not _is_little(data):
        return False
    tell(
        f"{counted(len(data), 'byte')} came from {port} in {seconds:g} s, which is little to judge by: "
        f"listening for up to {LONGER_S:g} s more; --seconds sets the time"
    )
    return True


def _is_little(data: bytes) -> bool:
    """Whether it is less than some lines or frames."""
    ends = max(data.count(b"\n"), data.count(b"\r"))
    return len(data) < LITTLE_BYTES and ends < _LITTLE_LINES


def _try(
    port: str,
    baud: int,
    parity: str,
    seconds: float,
    enough: int,
    stop: threading.Event,
    longer: Callable[[bytes], bool] | None = None,
) -> Tried:
    """Listen at one rate.

    Raises:
        SniffError: the port cannot be opened.
    """
    from drivers.serial.recognise import recognised  # noqa: PLC0415 - only for who listens

    with _opened(port, baud, parity) as device:
        heard = _listen(device.fileno(), seconds, enough, stop, longer)
    return Tried(baud, parity, heard, recognised(heard.data, heard.errors))


def _opened(port: str, baud: int, parity: str) -> Any:
    import termios  # noqa: PLC0415 - only for who listens

    import serial  # noqa: PLC0415

    from drivers.tty import is_pseudo_terminal, why_not_open  # noqa: PLC0415

    even = parity == "even" and not is_pseudo_terminal(port)
    try:
        return serial.Serial(
            port,
            baudrate=baud,
            parity=serial.PARITY_EVEN if even else serial.PARITY_NONE,
            timeout=0,
            inter_byte_timeout=0,
            exclusive=True,
        )
    except (OSError, ValueError, termios.error) as error:
        why = why_not_open(error, port, "the name").replace("the service's user", "your user")
        there = serial_ports()
        more = f" (ports of this computer: {', '.join(there)})" if there and "there is no" in why else ""
        raise SniffError(f"{port} cannot be opened: {why}{more}") from error


def _listen(
    descriptor: int,
    seconds: float,
    enough: int,
    stop: threading.Event,
    longer: Callable[[bytes], bool] | None = None,
) -> Heard:
    """Take what comes, until it is time, there is enough, or the port is lost.

    Where too little came by then, ``longer`` states whether to go on for a while.
    """
    from drivers.serial.reader import line_errors  # noqa: PLC0415 - only for who listens

    poll = select.poll()
    poll.register(descriptor, select.POLLIN)
    data = bytearray()
    marks: deque[tuple[int, float]] = deque()
    before = line_errors(descriptor)
    count, waiting, lost = 0, 0, ""
    first_s = last_s = begin_s = time.monotonic()
    whole = enough >= MOST_KEPT
    until_s, is_longer = begin_s + seconds, False
    while not stop.is_set() and (whole or count < enough):
        if is_longer and not _is_little(bytes(data)):
            break
        if time.monotonic() >= until_s:
            if is_longer or longer is None or not longer(bytes(data)):
                break
            until_s, is_longer = until_s + LONGER_S, True
        if not poll.poll(_POLL_MS):
            continue
        try:
            chunk = os.read(descriptor, _READ)
        except BlockingIOError:
            continue
        except OSError as error:
            lost = os.strerror(error.errno or errno.EIO)
            break
        if not chunk:
            lost = "it was unplugged"
            break
        last_s = time.monotonic()
        first_s = first_s if count else last_s
        count += len(chunk)
        marks.append((count, last_s))
        while marks[0][0] < count - MOST_KEPT:
            marks.popleft()
        waiting = count if last_s <= first_s + WAITING_S else waiting
        data += chunk
        del data[:-MOST_KEPT]
    after = None if lost else line_errors(descriptor)
    errors = 0 if before is None or after is None else (after.framing_errors - before.framing_errors) % 2**32
    return Heard(bytes(data), count, first_s, last_s, errors, lost, waiting, tuple(marks))
