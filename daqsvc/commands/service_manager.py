"""What a service reports to systemd: that it is ready, its status, that it is alive, that it stops.

The protocol is sd_notify(3): datagrams of assignments to the socket that ``$NOTIFY_SOCKET`` names. Without
that nothing is reported and nothing is watched.
"""

from __future__ import annotations

import asyncio
import logging
import os
import socket
import threading
import time
from collections import Counter
from typing import TYPE_CHECKING, Self

from daqsvc.errors.code import coded
from daqsvc.errors.service import WATCHDOG

if TYPE_CHECKING:
    from collections.abc import Callable

    from daqsvc.alarms.states import AlarmState
    from daqsvc.service import Service

log = logging.getLogger(__name__)

VARIABLES = ("NOTIFY_SOCKET", "WATCHDOG_USEC", "WATCHDOG_PID")
US_PER_S = 1_000_000
LONGEST_US = 20
"""Digits of what systemd counts to."""
LEAST_WATCH_S = 3.0
"""The shortest limit of parts: sound ones take a second or so now and then."""
SEND_S = 0.1
"""What a datagram may take: systemd takes them at once, unless it is being replaced by a new version."""

LOOK_S = 0.2
CHANGE_S = 1.0
"""A change of the status is reported no sooner than this time after the last one."""
REFRESH_S = 10.0
"""How often figures are reported that change all the time."""

EXTEND_EVERY_S, EXTEND_BY_S = 5.0, 30.0
START_MOST_S = 900.0
"""What opening the journal and compiling kernels may take, on the slowest box."""
TRIED_S = 10.0
"""How long a bus is waited for that the service can do without: some take long to be found absent."""

STARTING = "starting: the journal is opened and kernels are compiled, which takes long the first time only"
LONGEST_REASON = 80


class ServiceManager:
    """The socket of systemd, or of whoever else speaks its protocol.

    Args:
        address: ``$NOTIFY_SOCKET``: a path, or ``@`` and the name of an abstract socket; may be empty.
        watchdog_s: how soon a silent service is ended; None if it never is.

    Attributes:
        is_ready: whether it knows that the service is ready.
        begun_s: when `starting` was called, by the monotonic clock; None if it was not.
        is_overwritten: whether other words are shown in place of what the service waits for.
    """

    def __init__(self, address: str = "", watchdog_s: float | None = None) -> None:
        self.watchdog_s = watchdog_s if address else None
        self._address = f"\0{address[1:]}" if address.startswith("@") else address
        self.is_ready = False
        self.begun_s: float | None = None
        self.is_overwritten = False
        self._stopping = False
        self._says_reloading = False
        self._starting: threading.Thread | None = None
        self._started = threading.Event()
        self._socket: socket.socket | None = None
        if address:
            self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC)
            self._socket.settimeout(SEND_S)

    @classmethod
    def of_environment(cls) -> Self:
        """The one that has started this process; its variables are removed, they are for no child."""
        address, watchdog_us, watchdog_pid = (os.environ.pop(name, "") for name in VARIABLES)
        if not address.startswith(("/", "@")):
            return cls()
        ours = watchdog_pid in {"", f"{os.getpid()}"}
        if not (ours and watchdog_us):
            return cls(address)
        if not (watchdog_us.isdecimal() and len(watchdog_us) <= LONGEST_US and int(watchdog_us)):
            odd = "WatchdogSec= is ignored: WATCHDOG_USEC is %.40r, not a number of microseconds"
            log.warning(odd, watchdog_us, extra=coded(WATCHDOG))
            return cls(address)
        watchdog_s = int(watchdog_us) / US_PER_S
        if watchdog_s < LEAST_WATCH_S:
            short = "WatchdogSec= is %g s, and the limit of parts is %g s: write at least that"
            log.warning(short, watchdog_s, LEAST_WATCH_S, extra=coded(WATCHDOG))
        return cls(address, watchdog_s)

    def close(self) -> None:
        """Send nothing more."""
        self._end_starting()
        if self._socket is not None:
            self._socket.close()

    def tell(self, **assignments: object) -> bool:
        """Send a notice; True if it was sent, or if no manager expects any."""
        if self._socket is None:
            return True
        lines = "\n".join(f"{name}={' '.join(f'{value}'.split())}" for name, value in assignments.items())
        try:
            self._socket.sendto(lines.encode(), self._address)
        except OSError as error:
            log.info("the service manager cannot be sent %r: %s", lines, error)
            return False
        return True

    def starting(self) -> None:
        """The process begins to start: ask for time from now on, until `follow` does.

        On a thread, for imports and kernels block the main one for minutes on a small box. Time is asked for
        `START_MOST_S` at most: a start that hangs is ended by systemd soon after.
        """
        if self._socket is None or self.begun_s is not None:
            return
        self.begun_s = time.monotonic()
        self._starting = threading.Thread(target=self._ask_for_time, name="service manager", daemon=True)
        self._starting.start()

    def _ask_for_time(self) -> None:
        asked = 0
        while not (self._started.is_set() or self._stopping) and asked * EXTEND_EVERY_S < START_MOST_S:
            self.tell(STATUS=STARTING, EXTEND_TIMEOUT_USEC=round(EXTEND_BY_S * US_PER_S))
            asked += 1
            self._started.wait(EXTEND_EVERY_S)

    def _end_starting(self) -> None:
        self._started.set()
        starting, self._starting = self._starting, None
        if starting is not None:
            starting.join(2 * SEND_S)

    def reloading(self, *, begins: bool) -> None:
        """The service goes over to other machine files, or has done so.

        Before it is ready only in words: ``READY=1`` at the end would tell that it is, whatever it waits for.
        """
        if begins and self.is_ready:
            self._says_reloading = True
            self.tell(RELOADING=1, MONOTONIC_USEC=time.monotonic_ns() // 1000, STATUS="reloading")
        elif self._says_reloading:
            self._says_reloading = False
            self.tell(READY=1, STATUS="reloaded")
        else:
            self.tell(STATUS="reloading" if begins else "reloaded")
            self.is_overwritten = True

    def stopping(self) -> None:
        """The service stops; from any thread."""
        self._stopping = True  # no lock: it may be called while a signal interrupts anything
        self.tell(STOPPING=1, STATUS="stopping")

    async def follow(self, service: Service) -> None:
        """Report the state of a service and that it works, until cancelled; not for long on its event loop.

        It is reported ready when every bus delivers that it must have (`Service.awaited`), and to be alive
        for as long as none of its parts has stalled. A service that is not alive is started again by systemd.
        """
        if self._socket is None:
            return
        self._end_starting()
        follower = _Follower(self, service)
        while not self._stopping:
            follower.look(asyncio.get_running_loop().time())
            await asyncio.sleep(LOOK_S)


class _Follower:
    """What one service has reported."""

    def __init__(self, manager: ServiceManager, service: Service) -> None:
        self._manager = manager
        self._service = service
        self._stalled: Callable[[float], list[str]] | None = None
        if manager.watchdog_s is not None:
            then = "the service manager gets no more signs of life, and starts the service again"
            self._stalled = service.stalls.hold_to(max(manager.watchdog_s, LEAST_WATCH_S), then)
        self._begun_s = manager.begun_s
        self._serving_since_s = 0.0
        self._alive_s = self._extended_s = self._sent_s = self._refreshed_s = float("-inf")
        self._sent = ""

    def look(self, now_s: float) -> None:
        if self._begun_s is None:
            self._begun_s = now_s
        service = self._service
        if not service.ready.is_set():
            self._serving_since_s = now_s
            self._status(STARTING, STARTING, now_s)
            self._extend(now_s, gets_on=now_s - self._begun_s < START_MOST_S)
            return
        gets_on = self._stalled is None or not self._stalled(now_s)
        if not self._manager.is_ready:
            awaited = service.awaited(patient=now_s - self._serving_since_s < TRIED_S)
            if not awaited:
                text = "; ".join(filter(None, _in_short(service)))
                self._manager.is_ready = self._manager.tell(READY=1, STATUS=text)
            else:
                text = f"waiting for {', '.join(f'bus {bus}: {why}' for bus, why in awaited.items())}"
                self._status(text, text, now_s)
                self._extend(now_s, gets_on=gets_on)
                return
        self._status(*_in_short(service), now_s)
        if gets_on and self._manager.watchdog_s and now_s - self._alive_s >= self._manager.watchdog_s / 2:
            self._manager.tell(WATCHDOG=1)
            self._alive_s = now_s

    def _extend(self, now_s: float, *, gets_on: bool) -> None:
        if gets_on and now_s - self._extended_s >= EXTEND_EVERY_S:
            self._manager.tell(EXTEND_TIMEOUT_USEC=round(EXTEND_BY_S * US_PER_S))
            self._extended_s = now_s

    def _status(self, standing: str, figures: str, now_s: float) -> None:
        """Send ``standing`` with ``figures`` if it has changed, or was sent long ago."""
        if self._manager.is_overwritten:
            self._sent, self._manager.is_overwritten = "", False
        is_new = standing != self._sent and now_s - self._sent_s >= CHANGE_S
        if not is_new and now_s - self._refreshed_s < REFRESH_S:
            return
        if self._manager.tell(STATUS=standing if figures in {standing, ""} else f"{standing}; {figures}"):
            self._sent, self._sent_s, self._refreshed_s = standing, now_s, now_s


def _in_short(service: Service) -> tuple[str, str]:
    """How a service stands, and the figures that change all the time."""
    links = {driver.name: driver.link for driver in service.driver_reports}
    down = {name: link.reason or "it is being opened" for name, link in links.items() if link.state != "up"}
    count = len(links)
    up = f"{count - len(down)} of {count} buses up"
    if down:
        up += f" ({', '.join(f'{bus}: {reason[:LONGEST_REASON]}' for bus, reason in down.items())})"
    shown: Counter[AlarmState] = Counter()
    for manager in service.alarms.managers.values():
        shown.update(manager.shown)
    alarms = ", ".join(f"{number} {state.in_words}" for state, number in shown.items() if number)
    parts = [up, f"alarms: {alarms or 'none'}"]
    outbox = service.alarms.outbox.counters
    if outbox.shut or outbox.unbacked:
        parts.append("the journal cannot be written")
    for output in service.alarms.outputs.values():
        figures = output.figures()
        if "connected" in figures:
            why = f" ({output.reason[:LONGEST_REASON]})" * bool(output.reason)
            parts.append("broker connected" if figures["connected"] else f"broker not connected{why}")
    messages = outbox.depth + outbox.waiting
    what = "1 alarm message" if messages == 1 else f"{messages} alarm messages"
    if "mqtt" in service.alarms.outputs:
        return "; ".join(parts), f"{what} wait{'s' * (messages == 1)} for the broker"
    # Without one they are kept for a broker that a later machine file may name.
    return "; ".join(parts), f"{what} kept for a broker" if messages else ""
