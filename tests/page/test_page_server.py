"""The page's server: whom it answers, with what, and how it ends."""

from __future__ import annotations

import asyncio
import http.client
import signal
import socket
from typing import TYPE_CHECKING

import pytest
from support.browsers import page_served
from support.given_codes import had
from support.waiting import PATIENCE_S

from daqsvc.cli import main

if TYPE_CHECKING:
    from pathlib import Path

pytestmark = pytest.mark.integration


def ask(
    address: str, path: str, method: str = "GET", **headers: str
) -> tuple[int, str, http.client.HTTPMessage]:
    connection = http.client.HTTPConnection(address.removeprefix("http://"), timeout=60)
    try:
        connection.request(method, path, headers=headers)
        answer = connection.getresponse()
        return answer.status, answer.read().decode("latin-1"), answer.headers
    finally:
        connection.close()


@pytest.mark.long
async def test_strangers_are_not_answered(tmp_path: Path) -> None:
    async with page_served("--store", tmp_path) as (address, process):
        status, text, headers = await asyncio.to_thread(ask, address, "/")
        assert status == 200
        assert "no daqsvc answers on this box" in text
        assert f"{tmp_path}" not in text, "no path goes out"
        assert "script-src 'self';" in headers["content-security-policy"]
        assert "unsafe-eval" not in headers["content-security-policy"]
        assert headers["x-content-type-options"] == "nosniff"
        # A name of somebody else that leads here (DNS rebinding).
        assert (await asyncio.to_thread(ask, address, "/", host="evil.example"))[0] == 400
        assert (await asyncio.to_thread(ask, address, "/static/..%2f..%2fserver.py"))[0] == 404
        assert (await asyncio.to_thread(ask, address, "/static/server.py"))[0] == 404
        _, _, headers = await asyncio.to_thread(ask, address, "/static/bokeh.js")
        assert headers["content-encoding"] == "gzip"
        status, text, headers = await asyncio.to_thread(ask, address, "/machines/none%3Cb%3E/orbit")
        assert status == 404
        assert "<b>" not in text
        assert "content-security-policy" in headers
        status, text, headers = await asyncio.to_thread(ask, address, "/events/none")
        assert (status, headers["content-type"]) == (200, "text/event-stream; charset=utf-8")
        assert text.startswith("retry: 2000\ndata: "), "a browser asks again"
        assert (await asyncio.to_thread(ask, address, "/", "POST"))[0] == 405
        process.terminate()
        async with asyncio.timeout(30):
            await process.wait()
        assert process.returncode == 0


async def test_ctrl_c_ends_it_in_order_as_soon_as_it_says_so(tmp_path: Path) -> None:
    async with page_served("--store", tmp_path) as (_, process):
        process.send_signal(signal.SIGINT)
        async with asyncio.timeout(PATIENCE_S):
            await process.wait()
        assert process.returncode == 0


def test_a_port_that_is_taken_is_one_sentence(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        assert main(["page", "--store", f"{tmp_path}", "--port", f"{port}"]) == 1
    err = capsys.readouterr().err
    had("C17", err)
    assert err == (
        f"daqsvc page: cannot listen at 127.0.0.1:{port}: Address already in use; end what listens there, or "
        "give another --port [C17]\n"
    )
    with pytest.raises(SystemExit):
        main(["page", "--store", f"{tmp_path}", "--port", "70000"])
    assert "'70000' is no port: give a number from 0 to 65535" in capsys.readouterr().err


def test_a_port_that_the_page_of_the_service_has_is_said_to_be_its(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("daqsvc.control.ask_status", lambda _store: [{"outputs": {"page": {}}}])
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        assert main(["page", "--store", f"{tmp_path}", "--port", f"{port}"]) == 1
    said = capsys.readouterr().err
    assert f"127.0.0.1:{port} is in use, and the service on {tmp_path} shows its page itself" in said


def test_what_is_no_snapshot_is_one_sentence(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "odd.mcap"
    file.write_bytes(b"nonsense" * 100)
    assert main(["page", "--snapshot", f"{file}", "--port", "0"]) == 3
    assert capsys.readouterr().err.startswith(f"daqsvc page: {file} cannot be read: it ")
    with pytest.raises(SystemExit):
        main(["page", "--snapshot", f"{file}", "--store", f"{tmp_path}"])
    assert "leave the machine file and --store out" in capsys.readouterr().err
