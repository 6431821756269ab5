"""What the page costs, and how soon it shows what happens, in a real browser.

Run by ``make bench``; needs Chromium. A paper rotor (two probes and a keyphasor at 640 Hz) sends in real time
to a service, and a page is looked at: by nobody, by one browser, and by ten readers of its events, which cost
the page and the service what ten browsers do. A week of history is made for the trend.
"""

# ruff: noqa: T201 - printing is what it is for

from __future__ import annotations

import asyncio
import contextlib
import os
import shutil
import sys
import tempfile
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import psutil
from support.browsers import browsing, page_served
from support.many_machines import name_of, watched
from targets import Targets

from daqsvc.history.file import HistoryFile, Series
from daqsvc.history.points import RECORD
from daqsvc.page.machine_live import MachineLive
from daqsvc.page.views.all_views import VIEWS

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable

    from support.many_machines import Watched

ROUNDS, ROUND_S = 3, 4.0
VIEWERS = 10
MOST_SERVICE = 0.02
"""Of a core that ten viewers cost the service."""
MOST_PAGE = 0.25
MOST_PAGE_MB = 120.0
MOST_PAINT_MS = 1000.0
MOST_LATE_MS = 300.0
LEAST_UPDATES = 9.0
"""Of ten a second."""
MOST_TREND_S = 0.3
WEEK_S = 7 * 86_400

HEARD = """
window.late = [];
const Plain = window.EventSource;
window.EventSource = class extends Plain {
  set onmessage(then) {
    super.onmessage = (event) => {
      then(event);
      const taken = JSON.parse(event.data).taken_ms;
      // The next frame but one has been painted with it.
      requestAnimationFrame(() => requestAnimationFrame(() => window.late.push(Date.now() - taken)));
    };
  }
};
"""


async def share(cpu_s: Callable[[], float]) -> float:
    """Processor time for a second, the least of some rounds: what else the host does only adds to it."""
    costs = []
    for _ in range(ROUNDS):
        before, begun_s = cpu_s(), time.monotonic()
        await asyncio.sleep(ROUND_S)
        costs.append((cpu_s() - before) / (time.monotonic() - begun_s))
    return min(costs)


@contextlib.asynccontextmanager
async def readers(address: str, count: int) -> AsyncIterator[list[int]]:
    """Read the events of the orbit as browsers do; how many bytes have come to each."""
    host, port = address.removeprefix("http://").split(":")
    read = [0] * count

    async def one(number: int) -> None:
        reader, writer = await asyncio.open_connection(host, int(port))
        path = f"/events/{name_of(0)}/orbit"
        writer.write(f"GET {path} HTTP/1.1\r\nHost: {host}\r\n\r\n".encode())
        try:
            while part := await reader.read(65_536):
                read[number] += len(part)
        finally:
            writer.close()

    tasks = [asyncio.create_task(one(number)) for number in range(count)]
    try:
        yield read
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)


async def looked_at(plant: Watched, store: Path, targets: Targets) -> None:
    """By nobody, by ten readers, by a browser."""
    alone = await share(plant.cpu_s)
    async with page_served("--store", store) as (address, process):
        page = psutil.Process(process.pid)

        def page_s() -> float:
            times = page.cpu_times()
            return float(times.user + times.system)

        async with readers(address, VIEWERS) as read:
            await asyncio.sleep(2.0)
            watched_by_ten = await share(plant.cpu_s)
            page_by_ten = await share(page_s)
            assert min(read) > 0, "each reader is told"
        async with browsing() as browser:
            context = await browser.new_context()
            tab = await context.new_page()
            await tab.add_init_script(HEARD)
            await tab.goto(f"{address}/machines/{name_of(0)}/orbit")
            await asyncio.sleep(3.0)
            paint = "performance.getEntriesByName('first-contentful-paint')[0].startTime"
            paint_ms = float(await tab.evaluate(paint))
            await tab.evaluate("window.late.length = 0")
            begun_s = time.monotonic()
            page_by_one = await share(page_s)
            late_ms: list[float] = await tab.evaluate("window.late")
            updates = len(late_ms) / (time.monotonic() - begun_s)
        resident_mb = page.memory_info().rss / 2**20
    late = float(np.percentile(late_ms, 95))
    cost = max(watched_by_ten - alone, 1e-4)
    print(
        f"service {alone:.3f} of a core alone, {watched_by_ten:.3f} with {VIEWERS} viewers; page "
        f"{page_by_one:.3f} with one viewer, {page_by_ten:.3f} with {VIEWERS}, {resident_mb:.0f} MB"
    )
    ask = targets.ask
    ask(f"{VIEWERS} viewers cost the service at most 2 %", f"{cost:.2%}", MOST_SERVICE / cost)
    ask("the page takes at most 25 % of a core with one", f"{page_by_one:.1%}", MOST_PAGE / page_by_one)
    ask("the page holds at most 120 MB", f"{resident_mb:.0f} MB", MOST_PAGE_MB / resident_mb)
    ask("first paint within 1 s", f"{paint_ms:.0f} ms", MOST_PAINT_MS / paint_ms)
    ask("the orbit moves 10 times a second", f"{updates:.1f}", updates / LEAST_UPDATES)
    ask("from sample to screen within 300 ms, 95 %", f"{late:.0f} ms", MOST_LATE_MS / late)


def trend_s(folder: Path) -> float:
    """How long a trend of a week takes to be made for a browser, the least of some rounds."""
    now_s = int(time.time())
    t_s = now_s - WEEK_S + 60 * np.arange(WEEK_S // 60)
    seconds = np.zeros(len(t_s), RECORD)
    seconds["t_s"], seconds["n"] = t_s, 1
    seconds["mean"] = np.random.default_rng(1).normal(size=len(t_s))
    seconds["low"], seconds["high"] = seconds["mean"] - 1.0, seconds["mean"] + 1.0
    file = HistoryFile(folder / "history.sqlite")
    file.write({Series("rig", "levels/x", "statistic", "rms", "um"): seconds})
    for _ in file.pack(float(now_s)):
        pass
    file.close()
    about: dict[str, Any] = {"statements": [], "alarms": [], "standings": {}, "streams": {}}
    live = MachineLive({**about, "values": {"machine": {}}, "machine": "rig", "wall_ns_at_0": 0})
    live.history = folder / "history.sqlite"
    took_s = []
    for _ in range(5):
        begun_s = time.perf_counter()
        shown = VIEWS["trend"].shown(live, {"reading": "levels/x.rms", "hours": "168"})
        took_s.append(time.perf_counter() - begun_s)
    assert len(shown.sources["trend"]["t"]) > 1000
    return min(took_s)


def main() -> int:
    """Measure and print."""
    targets = Targets()
    if shutil.which("chromium") is None:
        print("page: not measured, no chromium on this machine (apt-get install chromium)")
        return targets.exit_code
    with tempfile.TemporaryDirectory(prefix="bench-page-") as name:
        folder = Path(name)
        took_s = trend_s(folder)
        targets.ask("a week of trend is made within 300 ms", f"{1e3 * took_s:.0f} ms", MOST_TREND_S / took_s)
        with watched(folder, 1, core=min(os.sched_getaffinity(0))) as plant:
            time.sleep(10.0)  # the device's clock is known, and the bank has measured the healthy machine
            asyncio.run(looked_at(plant, folder / "store", targets))
    return targets.exit_code


if __name__ == "__main__":
    sys.exit(main())
