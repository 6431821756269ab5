"""Which faults can be distinguished on a machine, by a separate process: it takes seconds, and memory."""

from __future__ import annotations

import asyncio
import contextlib
import json
import re
import sys
import tempfile
from collections import OrderedDict
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple, cast

from daqsvc.settings.plugins import detector_tables

if TYPE_CHECKING:
    from typing import Any

    from daqsvc.diagnosis.plugin import DetectorPlugin
    from daqsvc.page.machine_live import MachineLive

_PATH = re.compile(r"(?<!\w)/(?:[^/\s:'\"]+/)+")
MOST_KEPT = 50
LIMIT_S = 300.0
"""The first time kernels are compiled."""
NOT_HERE = "it needs files of the box: open the box's own page"


class Detectable(NamedTuple):
    """Which faults can be distinguished.

    Attributes:
        text: as `daqsvc detectability` prints it; empty if it cannot be computed.
        why_not: why it cannot be.
    """

    text: str
    why_not: str


def why_no_detector(live: MachineLive) -> str:
    """Why no fault can be distinguished on a machine, as far as its tables show; "" if something can be."""
    tables = detector_tables()
    known = [key for key, table in tables.items() if cast("DetectorPlugin[Any]", table).predictable]
    if any(key in live.values.get("pipeline", {}) for key in known):
        return ""
    return f"this machine has none of the detectors that can show it: {', '.join(known)}"


class Detectabilities:
    """Which faults can be distinguished on each machine asked for, computed once for each machine file."""

    def __init__(self) -> None:
        self._made: OrderedDict[tuple[str, int], asyncio.Task[Detectable]] = OrderedDict()
        self._one_at_a_time = asyncio.Lock()

    def of(self, live: MachineLive) -> Detectable | None:
        """That of a machine; None while it is being computed."""
        key = (live.name, live.token)
        if key not in self._made:
            self._made[key] = asyncio.create_task(self._compute(live), name=f"detectability of {live.name}")
            while len(self._made) > MOST_KEPT:
                self._made.popitem(last=False)[1].cancel()
        task = self._made[key]
        if not task.done() or task.cancelled():
            return None
        answer = Detectable("", "it has failed: try again later") if task.exception() else task.result()
        if answer.why_not:
            del self._made[key]  # whoever looks again has it computed again
        return answer

    async def close(self) -> None:
        """Compute no more."""
        tasks = {*self._made.values()}
        for task in tasks:
            task.cancel()
        if tasks:
            await asyncio.wait(tasks)

    async def _compute(self, live: MachineLive) -> Detectable:
        folder = live.about.get("folder", "")
        if not folder and _names_files(live.values):
            return Detectable("", NOT_HERE)
        async with self._one_at_a_time:
            with tempfile.TemporaryDirectory(prefix="daqsvc-page-") as scratch:
                values = Path(scratch) / "machine.json"
                await asyncio.to_thread(values.write_text, json.dumps(live.values))
                return await _asked(values, folder or scratch, is_here=bool(folder))


def _names_files(values: object) -> bool:
    """Whether a machine file of elsewhere names files, which are not to be opened here."""
    if isinstance(values, dict):
        return any(_names_files(one) for one in values.values())
    if isinstance(values, list):
        return any(_names_files(one) for one in values)
    is_file = isinstance(values, str) and (values.startswith("/") or ".." in values)
    return is_file and not str(values).startswith("/dev/")


async def _asked(values: Path, folder: str, *, is_here: bool) -> Detectable:
    """What the verb states."""
    process = await asyncio.create_subprocess_exec(
        *(sys.executable, "-m", "daqsvc", "detectability", f"{values}", "--values-in", folder),
        stdin=asyncio.subprocess.DEVNULL,
        stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.PIPE,
    )
    try:
        async with asyncio.timeout(LIMIT_S):
            out, err = await process.communicate()
    except TimeoutError:
        return Detectable("", f"it has taken longer than {LIMIT_S:g} s")
    finally:
        if process.returncode is None:
            with contextlib.suppress(ProcessLookupError):
                process.kill()
            await process.wait()
    if process.returncode == 0:
        return Detectable(out.decode(), "")
    lines = err.decode(errors="replace").strip().splitlines() or ["it has failed without a message"]
    # No path goes out, but units such as mm/s do.
    why = _PATH.sub("", lines[-1].replace(f"{values}: ", "").replace(f"{folder}/", ""))
    return Detectable("", why if is_here else f"{why}; {NOT_HERE}")
