"""Every task and every thread of a running service is killed, and the rest does not notice.

What there is to kill is found by looking, so that a task or a thread that is added later is killed, too.
"""

from __future__ import annotations

import asyncio
import contextlib
import ctypes
import gc
import threading
import urllib.request
from typing import TYPE_CHECKING, Any

import pytest
from support.brokers import Consumer
from support.busy_service import Devices, busy_machine
from support.given_codes import had
from support.waiting import PATIENCE_S, eventually

from daqsvc.acquisition.link import Backoff
from daqsvc.box import Box
from daqsvc.control import ControlError, ControlRequest, ask
from daqsvc.publish.metrics.settings import Metrics
from daqsvc.service import Service
from daqsvc.supervision import EssentialLostError

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable, Iterator
    from pathlib import Path

    from support.brokers import Mosquitto

pytestmark = pytest.mark.integration
WRITER = "outbox-writer"
"""The thread that the service cannot do without."""


@pytest.fixture(autouse=True)
def _one_accident_at_a_time(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Waits grow with each failure of a part that comes soon after another; these have nothing in common."""
    next_ns = Backoff.next_ns

    def first_ns(backoff: Backoff) -> int:
        backoff.reset()
        return next_ns(backoff)

    monkeypatch.setattr(Backoff, "next_ns", first_ns)
    yield
    gc.collect()  # tasks whose end nobody has asked for are logged then, and not during another test


class KilledError(Exception):
    """What the test throws."""


class Victim:
    """A service with everything on, and what belongs to it."""

    def __init__(
        self, service: Service, running: asyncio.Task[None], store: Path, consumer: Consumer
    ) -> None:
        self.service = service
        self.running = running
        self.others: set[object] = {running, asyncio.current_task()}
        self._store = store
        self._consumer = consumer

    def tasks(self) -> dict[str, asyncio.Task[Any]]:
        return {_name(t): t for t in asyncio.all_tasks() if t not in self.others and not t.done()}

    def threads(self) -> dict[str, threading.Thread]:
        return {
            t.name: t
            for t in threading.enumerate()
            if t not in self.others and t is not threading.main_thread()
        }

    def progress(self) -> dict[str, float]:
        """Figures each of which must grow."""
        figures = self.service.figures()
        grows: dict[str, float] = {
            f"samples of {n}": one.ring.end_index for n, one in self.service.streams.items()
        }
        grows |= {
            f"rows of {name}": grid["rows"] for name, grid in figures["grids"].items() if "rows" in grid
        }
        grows |= {f"windows of {name}": d["windows"] for name, d in figures["detectors"].items()}
        grows["frames in the recording"] = figures["buses"]["can0"]["frames_recorded"]
        grows["telemetry at the broker"] = figures["mqtt"]["telemetry_sent"]
        grows["status at the consumer"] = len(self._consumer.on("/status"))
        grows["Sparkplug"] = figures["sparkplug"]["data"]
        return grows

    async def check(self, what: str) -> None:
        """Acquisition, diagnosis, recording, publishing go on; a command reaches journal and broker."""
        assert not self.running.done(), f"{what}: the service has ended"
        before = self.progress()
        behind: set[str] = set()

        def all_go_on() -> bool:
            now = self.progress()
            behind.clear()
            behind.update(name for name in before if now[name] <= before[name])
            return not behind

        try:
            await eventually(all_go_on, f"everything goes on after {what}")
        except BaseException as error:
            error.add_note(f"after {what} these stand still: {sorted(behind)}")
            raise
        await eventually_async(self._is_healthy, f"metrics are served after {what}")
        told = len(self._consumer.on("/alarms/never"))
        for verb in ("shelve", "unshelve"):
            await eventually_async(lambda verb=verb: self._obeyed(verb), f"a command is obeyed after {what}")
        await eventually(
            lambda: len(self._consumer.on("/alarms/never")) >= told + 2, f"both are told after {what}"
        )

    async def _is_healthy(self) -> bool:
        metrics = self.service.box.own.output(Metrics)
        assert metrics is not None

        def answer() -> int:
            with urllib.request.urlopen(f"http://{metrics.listen}/healthz", timeout=1.0) as told:
                return int(told.status)

        with contextlib.suppress(OSError):
            return await asyncio.to_thread(answer) == 200
        return False

    async def _obeyed(self, verb: str) -> bool:
        duration_s = 60.0 if verb == "shelve" else None
        wish = ControlRequest(
            schema="daqsvc.control/1", verb=verb, alarm="never", by="t", reason="r", duration_s=duration_s
        )
        try:
            outcome = await asyncio.to_thread(ask, self._store, wish)
        except ControlError:
            return False
        # One that was obeyed although its answer was lost is refused when it is repeated.
        return outcome.accepted or "shelved" in outcome.reason


def _name(task: asyncio.Task[Any]) -> str:
    """What a task is called; one without a name, by what it does."""
    name = task.get_name()
    return name if not name.startswith("Task-") else getattr(task.get_coro(), "__qualname__", name)


async def eventually_async(condition: Callable[[], Any], what: str) -> None:
    for _ in range(round(PATIENCE_S / 0.1)):
        if await condition():
            return
        await asyncio.sleep(0.1)
    pytest.fail(f"waited in vain until {what}")


@contextlib.asynccontextmanager
async def victim(tmp_path: Path, broker: Mosquitto, name: str) -> AsyncIterator[Victim]:
    with Devices(name) as devices:
        machine = busy_machine(tmp_path, devices, broker.port)
        devices.play(machine)
        store = tmp_path / "store"
        async with Consumer(broker.port, "daqsvc/#") as consumer:
            known = {*asyncio.all_tasks(), *threading.enumerate()}
            service = Service(Box.single(machine), store)
            stop = asyncio.Event()
            running = asyncio.create_task(service.run(stop), name="service")
            found = Victim(service, running, store, consumer)
            found.others |= known
            try:
                await asyncio.wait(
                    {running, asyncio.ensure_future(service.ready.wait())},
                    return_when=asyncio.FIRST_COMPLETED,
                )
                await found.check("the start")
                yield found
            finally:
                stop.set()
                with contextlib.suppress(EssentialLostError):
                    await running


def throw(task: asyncio.Task[Any]) -> None:
    """Have what a task waits for fail; if that is another task, that one's turn comes by itself."""
    waiter = getattr(task, "_fut_waiter", None)
    if waiter is not None and not isinstance(waiter, asyncio.Task) and not waiter.done():
        waiter.set_exception(KilledError("thrown by the test"))


def kill_thread(thread: threading.Thread, error: type[BaseException]) -> None:
    assert thread.ident is not None
    ctypes.pythonapi.PyThreadState_SetAsyncExc(ctypes.c_ulong(thread.ident), ctypes.py_object(error))


# A thread that is killed between opening a file and the `with` around it leaves that file to the collector.
left_open = pytest.mark.filterwarnings("ignore:unclosed:ResourceWarning")


@pytest.mark.long
@left_open
async def test_all_at_once(tmp_path: Path, mosquitto: Mosquitto) -> None:
    async with victim(tmp_path, mosquitto, "at-once") as there:
        assert len(there.tasks()) > 20
        for task in there.tasks().values():
            task.cancel()
        await there.check("the end of all tasks")
        for task in there.tasks().values():
            throw(task)
        await there.check("an error in all tasks")
        threads = there.threads()
        assert WRITER in threads
        for name, thread in threads.items():
            if name != WRITER:
                kill_thread(thread, SystemExit)
        await there.check("the end of all threads but the journal's")
        failures = there.service.figures()["failures"]
        assert {"mqtt", "sparkplug", "metrics", "alarm times", "status", "pipeline", "driver can0"} <= set(
            failures
        )
        assert there.service.alarms.outbox.counters.telemetry.restarts == 1


@pytest.mark.long
@pytest.mark.timeout(1200)
@pytest.mark.parametrize("how", ["cancel", "throw"])
async def test_each_task_in_turn(how: str, tmp_path: Path, mosquitto: Mosquitto) -> None:
    async with victim(tmp_path, mosquitto, f"each-{how}") as there:
        done: set[str] = set()
        while left := sorted(there.tasks().keys() - done):
            done.add(left[0])
            task = there.tasks()[left[0]]
            if how == "cancel":
                task.cancel()
            else:
                throw(task)
            await there.check(f"{how} of {left[0]}")
        assert len(done) > 20


@pytest.mark.long
@pytest.mark.timeout(1200)
@left_open
@pytest.mark.parametrize("error", [KilledError, SystemExit])
async def test_each_thread_in_turn(error: type[BaseException], tmp_path: Path, mosquitto: Mosquitto) -> None:
    async with victim(tmp_path, mosquitto, f"threads-{error.__name__}") as there:
        done = {WRITER}
        while left := sorted(there.threads().keys() - done):
            done.add(left[0])
            kill_thread(there.threads()[left[0]], error)
            await there.check(f"{error.__name__} in thread {left[0]}")
        assert len(done) > 6


@pytest.mark.long
async def test_without_the_writer_of_its_journal_the_service_ends(
    tmp_path: Path, mosquitto: Mosquitto
) -> None:
    async with victim(tmp_path, mosquitto, "writer") as there:
        kill_thread(there.threads()[WRITER], KilledError)
        async with asyncio.timeout(20):
            with pytest.raises(EssentialLostError, match="no alarm can reach the disk any more") as lost:
                await there.running
            assert lost.value.code.id == "S05"
            had("S05", lost.value)
