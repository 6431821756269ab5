"""One Modbus line and its units: one request at a time, quiet after a failure, silent units set aside.

A reply on a serial line carries no number that shows which request it answers. One that comes after its
request was given up would be taken for the reply to the next request. So after every failure the line is
kept quiet, and bytes that arrive in this time are thrown away and counted. The same goes for a line that
has just been opened: whoever had it before may have asked for what is still to come.

A unit that is dead, or one request of a unit that lives, is set aside after a few requests without reply, and
asked again ever more rarely. A unit is dead when nothing that it is asked is answered any more: a queue that
it does not have must not cost its other streams their samples. What it answered before its silence began does
not show that it lives: of that the last is asked once more, and so it is with units that are asked rarely.
"""

from __future__ import annotations

import asyncio
import logging
from dataclasses import dataclass
from numbers import Integral
from typing import TYPE_CHECKING, NamedTuple, TypeAlias, TypeVar

from daqsvc.acquisition.clock import NS_PER_S
from daqsvc.acquisition.link import OFTEN, Sparing
from daqsvc.errors.buses import NO_ANSWER
from daqsvc.errors.code import coded
from daqsvc.notice import notice
from drivers.modbus.replies import (
    GATEWAY_CODES,
    READ_FIFO,
    WRITE_REGISTERS,
    LineLostError,
    NoReplyError,
    RequestRefusedError,
)
from drivers.modbus.settings import ModbusRtuBus

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Sequence

    from daqsvc.acquisition.clock import Clock
    from drivers.modbus.client import ModbusClient
    from drivers.modbus.registers import RegisterRun
    from drivers.modbus.replies import ModbusCounters
    from drivers.modbus.settings import ModbusBus


logger = logging.getLogger(__name__)

NS_PER_MS = 1_000_000
LONGEST_DEMOTION_NS = 60 * NS_PER_S

BITS_PER_CHARACTER = 11
"""Start, eight data, parity and stop bits, or a second stop bit without parity."""


class UnitSetAsideError(NoReplyError):
    """The unit, or this request of it, has stayed without reply, and it is not yet time to ask again."""


@dataclass(frozen=True, slots=True)
class RetryPolicy:
    """How long to wait for a line and its units.

    Attributes:
        quiet_ns: silence kept on a serial line after a request that failed; at least the response time-out.
        gap_ns: silence between frames on a serial line.
        demote_after: requests without reply, in a row, after which a unit, or one request, is set aside.
        demotion_ns: how long it is set aside, before one request probes whether it is back; twice as long
            after each probe without reply, up to `LONGEST_DEMOTION_NS` if that is more.
        timeout_ns: how long a unit may take to answer.
    """

    quiet_ns: int
    gap_ns: int
    demote_after: int = 3
    demotion_ns: int = 10 * NS_PER_S
    timeout_ns: int = 0

    @classmethod
    def of(cls, bus: ModbusBus) -> RetryPolicy:
        """What the table of a bus asks for."""
        timeout_ns = round(bus.timeout_ms * NS_PER_MS)
        quiet_ns = gap_ns = 0
        if isinstance(bus, ModbusRtuBus):
            # t3.5, at least 1.75 ms (Modbus over serial line 1.02, 2.5.1.1).
            gap_ns = max(round(3.5 * BITS_PER_CHARACTER * NS_PER_S / bus.baud), 1_750_000)
            asked_ns = 0 if bus.quiet_ms is None else round(bus.quiet_ms * NS_PER_MS)
            quiet_ns = max(timeout_ns, gap_ns, asked_ns)
        demotion_ns = round(bus.demotion_s * NS_PER_S)
        return cls(quiet_ns, gap_ns, bus.demote_after, demotion_ns, timeout_ns)

    @property
    def hold_ns(self) -> int:
        """How long a request without reply holds the line."""
        return self.timeout_ns + self.quiet_ns

    @property
    def opening_ns(self) -> int:
        """Silence on a serial line that was opened: as if whoever had it before had just asked."""
        return self.hold_ns if self.quiet_ns else 0

    @property
    def longest_demotion_ns(self) -> int:
        """The longest time from a probe to the next."""
        return max(self.demotion_ns, LONGEST_DEMOTION_NS)

    @property
    def of_probes(self) -> str:
        """When is asked again, in words."""
        first_s, longest_s = self.demotion_ns / NS_PER_S, self.longest_demotion_ns / NS_PER_S
        if first_s == longest_s:
            return f"asked again every {first_s:g} s"
        return f"asked again in {first_s:g} s, then after times that double up to {longest_s:g} s"


class RequestKey(NamedTuple):
    """What a unit is asked again and again; each is set aside by itself.

    Attributes:
        function: code of the function.
        what: what it is for, in words.
    """

    function: int
    what: str = ""

    def __str__(self) -> str:
        return f"function {self.function}" + (f" for {self.what}" if self.what else "")


@dataclass(slots=True)
class RequestHealth:
    """Requests without reply in a row, and when to ask again.

    Attributes:
        key: what was asked.
        failures: requests without reply in a row.
        wait_ns: how long it is set aside at a time.
        probe_ns: when to ask again; None if it is not set aside.
        answers: whether there was a reply when it was asked last, or it has not been asked yet.
        run: the registers that were read when it was answered last; None if nothing was, or if reading
            changes something, as in a queue.
        answered_ns: when that was.
    """

    key: RequestKey
    failures: int = 0
    wait_ns: int = 0
    probe_ns: int | None = None
    answers: bool = False
    run: RegisterRun | None = None
    answered_ns: int = 0

    def set_aside(self, patience: RetryPolicy, now_ns: int) -> bool:
        """Make no request for a while; returns whether that is new."""
        new = self.probe_ns is None
        self.wait_ns = patience.demotion_ns if new else min(2 * self.wait_ns, patience.longest_demotion_ns)
        self.probe_ns = now_ns + self.wait_ns
        return new

    def end(self) -> None:
        """There was an answer."""
        self.failures, self.probe_ns = 0, None


SparingByRequest: TypeAlias = dict[tuple[int, RequestKey], Sparing]
"""How often it was reported that a unit, or one of its requests, gets no reply."""


class UnitHealth:
    """Whether a unit answers, as far as is known: it, and each thing that it is asked.

    Args:
        unit: its address.
        patience: how long to wait for it.
        counters: of the bus.
        sparing: what has been logged of it, also while the line was open before.
    """

    def __init__(
        self,
        unit: int,
        patience: RetryPolicy,
        counters: ModbusCounters,
        sparing: SparingByRequest | None = None,
    ) -> None:
        self._unit = unit
        self._patience = patience
        self._counters = counters
        self._whole = RequestHealth(RequestKey(0, "anything"))
        self._requests: dict[RequestKey, RequestHealth] = {}
        self._last_words = ""
        self._sparing: SparingByRequest = {} if sparing is None else sparing
        self.silent_since_ns: int | None = None
        """When the first request without reply ended since the last reply; None if that was a reply."""
        self.heard_ns: int | None = None
        """When the last reply came; None if none has."""

    @property
    def dead(self) -> bool:
        """Whether the whole unit is set aside."""
        return self._whole.probe_ns is not None

    @property
    def witness(self) -> RequestHealth | None:
        """What to ask before anything is set aside, as nothing has been answered for so many requests."""
        if self.dead or self._whole.failures < self._patience.demote_after:
            return None
        return self.last_answered

    @property
    def last_answered(self) -> RequestHealth | None:
        """Of the requests that were answered when they were made last, the latest that can be repeated."""
        known = [one for one in self._requests.values() if one.answers and one.run is not None]
        return max(known, key=lambda one: one.answered_ns, default=None)

    def of(self, key: RequestKey) -> RequestHealth:
        """What is known of a request; one that is new may be answered."""
        health = self._requests.get(key)
        if health is None:
            health = self._requests[key] = RequestHealth(key, answers=_is_repeated(key))
        return health

    def forget(self, key: RequestKey) -> None:
        """Forget a request that will not be made again: its last reply does not show how the unit is now."""
        self._requests.pop(key, None)

    def check(self, health: RequestHealth, now_ns: int) -> None:
        """Make sure that this may be asked now.

        Raises:
            UnitSetAsideError: it is not yet time.
        """
        for kept in (self._whole, health):
            if kept.probe_ns is not None and now_ns < kept.probe_ns:
                what = "" if kept is self._whole else f"{health.key} of "
                raise UnitSetAsideError(f"{what}unit {self._unit} is set aside: {self._last_words}")

    def doubts(self, health: RequestHealth) -> bool:
        """Whether this may well stay without reply."""
        return self.dead or health.failures > 0

    def probes(self, health: RequestHealth) -> bool:
        """Whether this, asked now, is to find out if somebody is back."""
        return self.dead or health.probe_ns is not None

    def answered(
        self, health: RequestHealth, now_ns: int, run: RegisterRun | None = None, *, refused: bool = False
    ) -> None:
        """There was a reply.

        Args:
            health: of what was asked.
            now_ns: monotonic time now.
            run: the registers that were read, if they were.
            refused: whether the unit refuses: it lives now, but need not be asked that again.
        """
        health.answers = not refused and _is_repeated(health.key)
        health.run, health.answered_ns = run, now_ns
        self.silent_since_ns, self.heard_ns = None, now_ns
        if self.dead:
            self._counters.units_back += 1
            for other in self._requests.values():
                other.end()
        elif health.probe_ns is not None:
            self._counters.requests_back += 1
        if self._say_end(self._whole, "unit %d is back", self._unit):
            for (unit, _), sparing in self._sparing.items():
                if unit == self._unit:
                    sparing.may_take_back()
        self._say_end(health, "unit %d answers %s again", self._unit, health.key)
        self._whole.end()
        health.end()

    def missed(self, health: RequestHealth, why: str, now_ns: int) -> None:
        """There was no reply, because of ``why``; if there is a `witness`, nothing is set aside yet."""
        self._whole.failures += 1
        health.failures += 1
        health.answers = False
        self._last_words = why
        if self.silent_since_ns is None:
            self.silent_since_ns = now_ns
        if self.witness is None:
            self.judge(health, why, now_ns)

    def doubt_all(self) -> None:
        """The witness was silent, too: earlier replies to what could be asked again show nothing any more."""
        for one in self._requests.values():
            if one.run is not None:
                one.answers = False

    def judge(self, health: RequestHealth, why: str, now_ns: int) -> None:
        """Set the unit, or a request without reply, aside if that is due."""
        whole, patience = self._whole, self._patience
        lives = any(other.answers for other in self._requests.values())
        if not lives and whole.failures >= patience.demote_after:
            if whole.set_aside(patience, now_ns):
                self._counters.units_demoted += 1
            self._say(whole, "%s; the unit is set aside, and %s%s", why, patience.of_probes)
            if len(self._requests) > 1:
                # Something else is to probe next: this one may be what the unit does not know.
                health.probe_ns = now_ns + whole.wait_ns + patience.demotion_ns
        elif health.failures >= patience.demote_after:
            if health.set_aside(patience, now_ns):
                self._counters.requests_demoted += 1
            self._say(health, "%s; %s is set aside, and %s%s", why, health.key, patience.of_probes)

    def _say(self, health: RequestHealth, message: str, *arguments: object) -> None:
        sparing = self._sparing.setdefault((self._unit, health.key), Sparing())
        if sparing.may_say():
            logger.warning(message, *arguments, OFTEN if sparing.often else "", extra=coded(NO_ANSWER))

    def _say_end(self, health: RequestHealth, message: str, *arguments: object) -> bool:
        sparing = self._sparing.get((self._unit, health.key))
        if sparing is None or not sparing.may_take_back():
            return False
        notice(logger, message, *arguments)
        return True


def _is_repeated(key: RequestKey) -> bool:
    """Whether it is asked again and again: nothing need ever be written again."""
    return key.function != WRITE_REGISTERS


LONGEST_BABBLE = 4
"""Quiet times for which a line that does not fall silent is waited for, before it is used all the same."""

COURTESY_NS = 2_000_000
"""How long a request that may stay without reply stands back: no event loop wakes up to the millisecond."""

MOST_WRITTEN = 123
"""Registers that a request can write (Modbus Application Protocol 1.1b3, 6.12)."""

MOST_VALUE = 0xFFFF

Result = TypeVar("Result")

if TYPE_CHECKING:
    Request: TypeAlias = Callable[[], Awaitable[Result]]


class WriteRefusedError(PermissionError):
    """The machine file does not allow to write these registers."""


class RegisterValues(NamedTuple):
    """Registers, and when they were read.

    Attributes:
        registers: high byte of each first.
        asked_ns: when the request went out, host monotonic.
        answered_ns: when its reply was there.
    """

    registers: bytes
    asked_ns: int
    answered_ns: int


class ModbusLine:
    """An open line. It is lost when its connection is, or when no unit of it answers any more.

    Args:
        client: the connection; it has just been opened.
        clock: the service's clock.
        counters: of the bus.
        patience: see there.
        units: the units that are asked.
        may_write: whether registers may be written: unit, first register, how many.
        heard: called when a unit has answered.
        sparing: what has been logged of its units, also while it was open before.
    """

    def __init__(
        self,
        client: ModbusClient,
        clock: Clock,
        counters: ModbusCounters,
        patience: RetryPolicy,
        *,
        units: Sequence[int],
        may_write: Callable[[int, int, int], bool] = lambda _unit, _address, _count: False,
        heard: Callable[[], None] = lambda: None,
        sparing: SparingByRequest | None = None,
    ) -> None:
        self.lost: asyncio.Future[str] = asyncio.get_running_loop().create_future()
        self._client = client
        self._clock = clock
        self._counters = counters
        self._patience = patience
        self._sparing: SparingByRequest = {} if sparing is None else sparing
        self._units = {unit: UnitHealth(unit, patience, counters, self._sparing) for unit in units}
        self._may_write = may_write
        self._heard = heard
        self._lock = asyncio.Lock()
        self._quiet_until_ns = clock.monotonic_ns() + patience.opening_ns
        self._failed = False
        self._due_ns: dict[object, int] = {}

    def expect(self, who: object, due_ns: int) -> None:
        """Note the time of the next request: what may stay without reply is sent between such times."""
        self._due_ns[who] = due_ns

    def forget(self, unit: int, function: int, what: str) -> None:
        """Forget what a unit has been asked and will not be asked again: see `poll`."""
        if (asked := self._units.get(unit)) is not None:
            asked.forget(RequestKey(function, what))

    async def poll(self, unit: int, function: int, run: RegisterRun, what: str = "") -> RegisterValues:
        """Read registers, and state when that was; see `read`."""
        key = RequestKey(function, what)
        return RegisterValues(
            *await self._ask(
                unit, key, lambda: self._client.read(unit, function, run.address, run.count), run
            )
        )

    async def read(self, unit: int, function: int, run: RegisterRun, what: str = "") -> bytes:
        """Read registers; see `ModbusClient.read` for what is returned and raised.

        Args:
            unit: address of the unit.
            function: see `ModbusClient.read`.
            run: the registers.
            what: what is read, in words. Requests of one function for the same are set aside together, if
                they stay without reply while the unit answers others.

        Raises:
            UnitSetAsideError: there was no reply before, and it is not yet time to ask again.
        """
        return (await self.poll(unit, function, run, what)).registers

    async def read_fifo(self, unit: int, address: int, what: str = "") -> bytes:
        """Read a FIFO queue; see `read`."""
        key = RequestKey(READ_FIFO, what)
        registers, _, _ = await self._ask(unit, key, lambda: self._client.read_fifo(unit, address))
        return registers

    async def write(self, unit: int, address: int, values: Sequence[int]) -> None:
        """Write holding registers that the machine file allows to write; see `read`.

        Raises:
            ValueError: registers cannot hold these values, or a request so many; nothing has been sent.
            WriteRefusedError: the machine file does not allow it; nothing has been sent.
        """
        _check_values(values)
        if not self._may_write(unit, address, len(values)):
            raise WriteRefusedError(
                f"registers {address} to {address + len(values) - 1} of unit {unit} must not be written; add "
                f"{{ unit = {unit}, address = {address}, count = {len(values)} }} to writes of the bus if "
                "they may"
            )
        await self._ask(unit, RequestKey(WRITE_REGISTERS), lambda: self._client.write(unit, address, values))

    async def _ask(
        self, unit: int, key: RequestKey, request: Request[Result], run: RegisterRun | None = None
    ) -> tuple[Result, int, int]:
        """Make a request as soon as it may be; returns its result, when it went out and when it ended."""
        asked = self._units.get(unit)
        if asked is None:
            asked = self._units[unit] = UnitHealth(unit, self._patience, self._counters, self._sparing)
        health = asked.of(key)
        if asked.doubts(health):
            asked.check(health, self._clock.monotonic_ns())
            await self._let_others_go_first()
        async with self._lock:
            await self._keep_quiet()
            if asked.doubts(health):
                asked.check(health, self._clock.monotonic_ns())
                self._counters.probes += asked.probes(health)
            was_dead = asked.dead
            try:
                return await self._exchange(asked, health, request, run)
            except NoReplyError as error:
                await self._look_for_life(unit, health, f"{error}", was_dead=was_dead)
                raise
            except RequestRefusedError as error:
                if error.code in GATEWAY_CODES:
                    await self._look_for_life(unit, health, f"{error}", was_dead=was_dead)
                raise

    async def _exchange(
        self, asked: UnitHealth, health: RequestHealth, request: Request[Result], run: RegisterRun | None
    ) -> tuple[Result, int, int]:
        """Send a request, and note how it ended; to be called with the lock, when the line is quiet."""
        asked_ns = self._clock.monotonic_ns()
        self._failed = True  # until a reply is there: also if this task is cancelled meanwhile
        ended_ns = 0
        try:
            result = await request()
        except LineLostError as error:
            self._lose(f"{error}")
            raise
        except NoReplyError as error:
            asked.missed(health, f"{error}", self._clock.monotonic_ns())
            raise
        except RequestRefusedError as error:
            self._failed = False
            if error.code in GATEWAY_CODES:
                asked.missed(health, f"{error}", self._clock.monotonic_ns())
            else:
                self._heard()
                asked.answered(health, self._clock.monotonic_ns(), refused=True)
            raise
        else:
            self._failed = False
            self._heard()
            ended_ns = self._clock.monotonic_ns()
            asked.answered(health, ended_ns, run)
            return result, asked_ns, ended_ns
        finally:
            silence_ns = self._patience.quiet_ns if self._failed else self._patience.gap_ns
            self._quiet_until_ns = (ended_ns or self._clock.monotonic_ns()) + silence_ns

    async def _look_for_life(self, unit: int, health: RequestHealth, why: str, *, was_dead: bool) -> None:
        """After a request without reply: find out whether its unit lives, and whether any does.

        A poll ends with its first request without reply, and a stream may be asked for once an hour. So what
        was answered before the silence began is asked again, once.
        """
        asked = self._units[unit]
        if (witness := asked.witness) is not None:
            if not await self._is_answered(unit, witness):
                asked.doubt_all()
            asked.judge(health, why, self._clock.monotonic_ns())
        all_dead = all(one.dead for one in self._units.values())
        if all_dead or (asked.dead and not was_dead and await self._are_others_silent(asked)):
            self._lose(f"no unit answers; the last one asked: {why}")

    async def _are_others_silent(self, dead: UnitHealth) -> bool:
        """Whether no unit answers since this one does not, which has just been set aside."""
        since_ns = dead.silent_since_ns or 0
        unknown = False
        for unit, other in list(self._units.items()):
            if other.dead:
                continue
            if (other.heard_ns or 0) > since_ns:
                return False
            last = other.last_answered
            if last is None:  # not asked yet, or silent, too, and not for long enough
                unknown = True
            elif await self._is_answered(unit, last):
                return False
        return not unknown

    async def _is_answered(self, unit: int, witness: RequestHealth) -> bool:
        """Read again what a unit answered last; whether it still answers."""
        await self._keep_quiet()
        run, function = witness.run, witness.key.function
        assert run is not None  # noqa: S101 - else it is none
        try:
            await self._exchange(
                self._units[unit],
                witness,
                lambda: self._client.read(unit, function, run.address, run.count),
                run,
            )
        except NoReplyError:
            return False
        except RequestRefusedError as error:
            return error.code not in GATEWAY_CODES
        return True

    async def _let_others_go_first(self) -> None:
        """Line up behind all that is due soon: what stays without reply holds the line for long.

        Neighbours that are polled as rarely as that lose nothing if it begins just after them.
        """
        hold_ns = self._patience.hold_ns
        begun_ns = self._clock.monotonic_ns()
        until_ns = begun_ns
        while until_ns - begun_ns < hold_ns:
            now_ns = self._clock.monotonic_ns()
            soon = [due_ns for due_ns in self._due_ns.values() if until_ns < due_ns < now_ns + hold_ns // 2]
            if not soon:
                break
            until_ns = max(soon)
            await self._clock.sleep_ns(until_ns - now_ns)
        await self._clock.sleep_ns(COURTESY_NS)
        async with self._lock:
            pass

    async def _keep_quiet(self) -> None:
        """Wait out the quiet time; a late reply makes it longer by a frame's gap."""
        if self._quiet_until() <= self._clock.monotonic_ns():
            return
        longest_ns = self._quiet_until_ns + LONGEST_BABBLE * self._patience.quiet_ns
        while (left_ns := min(self._quiet_until(), longest_ns) - self._clock.monotonic_ns()) > 0:
            await self._clock.sleep_ns(left_ns)

    def _quiet_until(self) -> int:
        return max(self._quiet_until_ns, self._client.last_byte_ns + self._patience.gap_ns)

    def _lose(self, why: str) -> None:
        if not self.lost.done():
            self.lost.set_result(why)


def _check_values(values: Sequence[int]) -> None:
    """Make sure that a request can write these.

    Raises:
        ValueError: it cannot.
    """
    if not 1 <= len(values) <= MOST_WRITTEN:
        raise ValueError(
            f"{len(values)} values to be written; a request writes 1 to {MOST_WRITTEN} registers"
        )
    for value in values:
        if not isinstance(value, Integral) or not 0 <= value <= MOST_VALUE:
            raise ValueError(
                f"value {value!r} to be written; a register holds whole numbers 0 to {MOST_VALUE}"
            )
