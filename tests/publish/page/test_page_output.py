"""The page that the service starts: it is there, comes back, says why not, and ends with the service."""

from __future__ import annotations

import asyncio
import contextlib
import os
import signal
import socket
import sys
import urllib.request
from typing import TYPE_CHECKING, Any

import pytest
from support.live_service import running
from support.machine_files import LAVAL, parsed
from support.ports import free_port
from support.waiting import PATIENCE_S, eventually

from daqsvc.publish.page.output import PageOutput
from daqsvc.publish.page.plugin import PagePlugin
from daqsvc.publish.page.settings import Page

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from daqsvc.settings.problems import Finding

pytestmark = pytest.mark.integration


def get(port: int) -> str:
    address = f"http://127.0.0.1:{port}/"
    with urllib.request.urlopen(address, timeout=PATIENCE_S) as answer:
        text: str = answer.read().decode()
    return text


@contextlib.asynccontextmanager
async def kept(output: PageOutput) -> Any:
    keeping = asyncio.create_task(output.run())
    try:
        yield keeping
    finally:
        keeping.cancel()
        await asyncio.wait({keeping})


async def test_the_service_starts_its_page_which_shows_its_machine(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("INFO")
    port = free_port()
    virtual = ('interface = "socketcan"', 'interface = "virtual"')
    table = f'[page]\nlisten = "127.0.0.1:{port}"\n\n[mqtt]'
    machine = parsed(LAVAL, virtual, ("[mqtt]", table)).model_copy(update={"mqtt": None})
    async with running(machine, tmp_path / "store"):
        async with asyncio.timeout(PATIENCE_S):
            while True:
                with contextlib.suppress(OSError):
                    if "laval-rig" in await asyncio.to_thread(get, port):
                        break
                await asyncio.sleep(0.2)
    with pytest.raises(OSError, match="refused"):
        await asyncio.to_thread(get, port)
    assert "left behind" not in caplog.text
    assert "the page of" in caplog.text
    assert "Ctrl-C" not in caplog.text, "that would end the service"


async def test_a_page_has_the_time_of_the_stop_to_end(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    port = free_port()
    output = PageOutput([f"--listen=127.0.0.1:{port}"], f"127.0.0.1:{port}", tmp_path)
    running = asyncio.create_task(output.run())
    await eventually(lambda: output.figures()["up"] == 1, "it listens")
    await asyncio.to_thread(get, port)
    process = output._process
    assert process is not None
    await output.stop(PATIENCE_S)
    await running
    assert process.returncode == 0, "it has ended by itself"
    assert output.figures() == {"up": 0, "starts": 1}
    assert "started again" not in caplog.text


@pytest.mark.gives("O25")
async def test_lines_of_its_log_keep_their_level(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    page = (
        "import logging, sys\n"
        "from daqsvc.cli import start_logging\n"
        "from daqsvc.errors.code import coded\n"
        "from daqsvc.errors.outputs import BROKER_AWAY\n"
        "from daqsvc.notice import notice\n"
        "start_logging(verbose=False)\n"
        "log = logging.getLogger('page')\n"
        "log.error('the broker is away', extra=coded(BROKER_AWAY))\n"
        "notice(log, 'the broker is back')\n"
        "log.info('all is well')\n"
        "print('odd', file=sys.stderr)\n"
    )
    output = PageOutput([], "nowhere", tmp_path)
    output._command = (sys.executable, "-c", page)
    running = asyncio.create_task(output.run())
    await eventually(lambda: output.reason, "it has ended")
    await output.stop(PATIENCE_S)
    await running
    said = [(one.levelname, one.getMessage()) for one in caplog.records if "page: " in one.getMessage()]
    assert said == [
        ("ERROR", "page: the broker is away [O09]"),
        ("NOTICE", "page: the broker is back"),
        ("WARNING", "page: odd"),
    ]
    assert output.reason == "odd"


async def test_a_page_that_does_not_end_is_killed_at_the_deadline(tmp_path: Path) -> None:
    deaf = (
        "import signal\n"
        "signal.signal(signal.SIGTERM, signal.SIG_IGN)\n"
        "print('here', flush=True)\n"
        "while True: signal.pause()\n"
    )
    output = PageOutput([], "nowhere", tmp_path)
    output._command = (sys.executable, "-c", deaf)
    running = asyncio.create_task(output.run())
    await eventually(lambda: output.figures()["up"] == 1, "it is there")
    process = output._process
    assert process is not None
    await output.stop(0.05)
    await running
    assert process.returncode == -signal.SIGKILL


async def test_a_page_that_waits_to_start_again_ends_at_once(tmp_path: Path) -> None:
    output = PageOutput([], "nowhere", tmp_path)
    output._command = (str(tmp_path / "absent"),)
    running = asyncio.create_task(output.run())
    await eventually(lambda: output.reason, "it says why")
    await output.stop(PATIENCE_S)
    await running


@pytest.mark.long
@pytest.mark.gives("O19")
async def test_a_page_that_is_killed_comes_back(tmp_path: Path) -> None:
    port = free_port()
    output = PageOutput([f"--listen=127.0.0.1:{port}"], f"127.0.0.1:{port}", tmp_path)
    async with kept(output):
        await eventually(lambda: output.figures()["up"] == 1, "it listens")
        assert "no daqsvc answers on this box" in await asyncio.to_thread(get, port)
        first = output.pid
        assert first is not None
        os.kill(first, signal.SIGKILL)
        await eventually(lambda: output.figures() == {"up": 1, "starts": 2}, "another one listens")
        assert output.pid != first
        assert output.reason == ""
    with pytest.raises(ProcessLookupError):
        os.kill(first, 0)


@pytest.mark.long
async def test_a_port_that_is_taken_is_said_and_taken_later(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        output = PageOutput([f"--listen=127.0.0.1:{port}"], f"127.0.0.1:{port}", tmp_path)
        keeping = asyncio.create_task(output.run())
        await eventually(lambda: output.reason, "it says why")
        assert f"cannot listen at 127.0.0.1:{port}: Address already in use" in output.reason
        assert "write another listen in [page]" in output.reason
        assert "--port" not in output.reason, "nobody who starts a service has given one"
    await eventually(lambda: output.figures()["up"] == 1, "it listens")
    keeping.cancel()
    await asyncio.wait({keeping})
    assert "is started again: cannot listen" in caplog.text
    assert caplog.text.count("cannot listen") == 1


async def test_what_each_start_says_in_the_same_words_is_said_once(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    output = PageOutput([], "nowhere", tmp_path)
    says = "import sys\nsys.exit('the disk is old\\ndaqsvc page: no picture of it')"
    output._command = (sys.executable, "-c", says)
    async with kept(output):
        await eventually(lambda: output.figures()["starts"] == 4, "it is started again and again")
    assert [record.getMessage() for record in caplog.records] == [
        "page: the disk is old",
        "the page at nowhere has ended, and is started again: no picture of it",
    ]


async def test_a_page_ends_with_a_service_that_is_killed(tmp_path: Path) -> None:
    port = free_port()
    program = (
        "import asyncio, pathlib, sys\n"
        "from daqsvc.publish.page.output import PageOutput\n"
        "there = '127.0.0.1:' + sys.argv[1]\n"
        "asyncio.run(PageOutput(['--listen=' + there], there, pathlib.Path(sys.argv[2])).run())\n"
    )
    service = await asyncio.create_subprocess_exec(sys.executable, "-c", program, f"{port}", f"{tmp_path}")
    async with asyncio.timeout(PATIENCE_S):
        while True:
            with contextlib.suppress(OSError):
                await asyncio.to_thread(get, port)
                break
            await asyncio.sleep(0.2)
        service.kill()
        await service.wait()
        while True:
            try:
                await asyncio.to_thread(get, port)
            except OSError:
                return
            await asyncio.sleep(0.2)


def found(**settings: Any) -> list[Finding]:
    def every() -> Iterator[Finding]:
        draft: Any = None
        for one in PagePlugin().checks(draft, Page(**settings)):
            yield from one

    return list(every())


@pytest.mark.parametrize(
    ("settings", "key"),
    [
        ({"listen": "0.0.0.0:8420", "user_header": "X", "proxies": ["::1"]}, "listen"),
        ({"listen": "192.0.2.7:8420", "accounts_file": "a"}, "listen"),
        ({"certificate_file": "c"}, "certificate_file"),
        ({"private_key_file": "c"}, "private_key_file"),
        ({"user_header": "X-User"}, "user_header"),
        ({"proxies": ["127.0.0.1"]}, "proxies"),
        ({"operators": ["ann"]}, "operators"),
        ({"accounts_file": "a", "user_header": "X", "proxies": ["::1"]}, "accounts_file"),
    ],
)
def test_what_is_unsafe_is_an_error_of_the_machine_file(settings: dict[str, Any], key: str) -> None:
    [finding] = found(**settings)
    assert finding.path == ("page", key)
    assert finding.fatal
    assert finding.remedy


def test_what_is_safe_is_none() -> None:
    assert found() == []
    tls = {"certificate_file": "c", "private_key_file": "k", "accounts_file": "a"}
    assert found(listen="192.0.2.7:1", **tls) == []
    assert found(listen="[::]:1", host_names=["box"], **tls) == []
    assert found(listen="192.0.2.7:1", user_header="X-User", proxies=["192.0.2.8"], operators=["ann"]) == []
