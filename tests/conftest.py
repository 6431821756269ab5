"""What every test is held to: no task and no thread outlives it. And where the recordings lie."""

from __future__ import annotations

import asyncio
import gc
import inspect
import os
import signal
import sys
import threading
import time
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
import pytest_asyncio
from hypothesis import settings
from hypothesis.internal.conjecture import providers
from support.examples import examples
from support.given_codes import codes_logged, unknown
from support.paths import ROOT

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Generator, Iterator

# The machine that runs this may be slow and shared: what counts is what is right, not when.
# The same examples in every run, so that a red run is red again; DAQSVC_ROAM=1 looks for new ones.
ROAM = os.environ.get("DAQSVC_ROAM") == "1"
settings.register_profile(
    "daqsvc", deadline=None, print_blob=True, derandomize=not ROAM, max_examples=examples(100)
)
settings.load_profile("daqsvc")
if not ROAM:
    # Else numbers that stand in our modules are drawn, too, and which are loaded is different in each worker.
    providers._get_local_constants = providers.Constants

# jsonschema would build 38 grammars of addresses, which no schema of ours has: five seconds in each process.
sys.modules.setdefault("rfc3987_syntax", None)  # type: ignore[arg-type]

DATA = Path(os.environ.get("DAQSVC_DATA", ROOT / ".." / "shared" / "data")).resolve()
GRACE_S = 30.0
"""For what ends by itself, on a computer however busy: only what is left behind takes so long."""

pytest_plugins = ["support.fixtures"]
KINDS = ("property", "integration", "statistical", "hil", "conformance")
"""A file says its kind by its ``pytestmark``, or lies in the folder of that name; others are unit tests."""


# A shell's background job, and nohup, ignore these, and what the tests start would inherit it.
signal.signal(signal.SIGINT, signal.default_int_handler)
signal.signal(signal.SIGHUP, signal.SIG_DFL)


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Generator[None, object, object]:
    """What is imported stays: to look through it for garbage each time takes seconds in each process."""
    gc.disable()
    try:
        return (yield)
    finally:
        gc.collect()  # once: what a module leaves unclosed is found, as what a test does is
        gc.freeze()
        gc.enable()


@pytest.fixture(scope="session")
def data() -> Path:
    """The folder of recordings; skips if there is none."""
    if not DATA.is_dir():
        pytest.skip(f"no recordings at {DATA}; set DAQSVC_DATA to where they are")
    return DATA


@pytest.fixture(autouse=True)
def _no_leaked_threads() -> Iterator[None]:
    before = set(threading.enumerate())
    yield
    until = time.monotonic() + GRACE_S
    while leaked := [t for t in set(threading.enumerate()) - before if not t.name.startswith("asyncio_")]:
        if time.monotonic() > until:
            pytest.fail(f"threads that outlive the test: {[t.name for t in leaked]}")
        time.sleep(0.01)


@pytest_asyncio.fixture
async def _no_leaked_tasks() -> AsyncIterator[None]:
    yield
    leaked = asyncio.all_tasks() - {asyncio.current_task()}
    if leaked:
        # Cancelled while a kernel ran, a task ends with it: later than a stop waits on a busy computer.
        _, leaked = await asyncio.wait(leaked, timeout=GRACE_S)
    if leaked:
        pytest.fail(f"tasks that outlive the test: {sorted(t.get_name() for t in leaked)}")


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call(item: pytest.Item) -> Generator[None]:
    """Warnings have codes, and a test that is marked with ``gives`` makes lines with these, or fails."""
    mark = item.get_closest_marker("gives")
    wanted = set() if mark is None else {*mark.args}
    with codes_logged() as codes:
        outcome = yield
    absent = sorted(wanted - codes.given.keys())
    assert not absent, f"no line of the log has {', '.join(absent)}"
    other = [code for code in sorted(wanted) if unknown(code, codes.given[code])]
    assert not other, (
        f"the message of {', '.join(other)} is another than in tests/errors/messages.txt: correct it there "
        "(DAQSVC_TAKE_MESSAGES=1 adds it), and the example in daqsvc/errors if it was that one"
    )
    assert not codes.lacking, f"lines of the log from WARNING on have no code: {codes.lacking}"
    return outcome


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport() -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """What a test has printed or logged may be no Unicode, and a worker can only pass on what is."""
    report = yield
    report.sections = [(title, _encodable(text)) for title, text in report.sections]
    if (said := report.longreprtext) != _encodable(said):
        report.longrepr = _encodable(said)
    return report


def _encodable(text: str) -> str:
    return text.encode(errors="backslashreplace").decode()


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    items.sort(key=lambda item: item.get_closest_marker("first") is None)
    for item in items:
        marks = {mark.name for mark in item.iter_markers()}
        if (suite := item.path.parent.name) in KINDS:
            item.add_marker(suite)
            marks.add(suite)
        if marks.isdisjoint(KINDS):
            item.add_marker(pytest.mark.unit)
        if "statistical" in marks:
            item.add_marker(pytest.mark.long)
        if isinstance(item, pytest.Function) and inspect.iscoroutinefunction(item.obj):
            item.fixturenames.insert(0, "_no_leaked_tasks")
