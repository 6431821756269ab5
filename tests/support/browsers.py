"""A real browser for tests, and a separate page server."""

from __future__ import annotations

import asyncio
import contextlib
import os
import re
import shutil
import sys
from typing import TYPE_CHECKING, Any

import pytest
from playwright.async_api import async_playwright
from support.waiting import PATIENCE_S

if TYPE_CHECKING:
    from collections.abc import AsyncIterator
    from pathlib import Path

    from playwright.async_api import Browser, Page


def chromium() -> str:
    """The program; skips if there is none, unless that is forbidden."""
    program = shutil.which("chromium")
    if program is None:
        if os.environ.get("DAQSVC_REQUIRE_CHROMIUM") == "1":
            pytest.fail("no chromium on this machine (apt-get install chromium)")
        pytest.skip("no chromium on this machine (apt-get install chromium)")
    return program


@contextlib.asynccontextmanager
async def browsing() -> AsyncIterator[Browser]:
    """A browser without a window."""
    async with async_playwright() as playwright:
        # Of root Chromium asks that it be without its sandbox.
        browser = await playwright.chromium.launch(
            executable_path=chromium(), args=["--no-sandbox", "--disable-dev-shm-usage"]
        )
        try:
            yield browser
        finally:
            await browser.close()


@contextlib.asynccontextmanager
async def page_served(
    *arguments: str | int | Path, may_say: str = ""
) -> AsyncIterator[tuple[str, asyncio.subprocess.Process]]:
    """``daqsvc page`` with these arguments, at a free port unless they say one; its address and process.

    Lines of its log that have ``may_say`` in them are as they should be; there may be no others.
    """
    port = () if {"--port", "--listen"} & {*arguments} else ("--port", 0)
    process = await asyncio.create_subprocess_exec(
        *(sys.executable, "-m", "daqsvc", "page", *map(str, (*arguments, *port))),
        stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.PIPE,
    )
    assert process.stdout is not None
    assert process.stderr is not None
    try:
        async with asyncio.timeout(PATIENCE_S):
            said = (await process.stdout.readline()).decode()
        assert re.search(r" is at https?://127\.0\.0\.1:", said), (
            said or (await process.stderr.read()).decode()
        )
        yield said.split(" is at ")[1].split(";")[0].rstrip("/"), process
    finally:
        if process.returncode is None:
            process.terminate()
        _, err = await process.communicate()
    wrong = [line for line in err.decode().splitlines() if not may_say or may_say not in line]
    assert not wrong, "\n".join(["the page's server has logged:", *wrong])


@contextlib.asynccontextmanager
async def tab(browser: Browser, **options: Any) -> AsyncIterator[Page]:
    """A tab in which nothing may go wrong, and which may ask nobody but the page's server."""
    context = await browser.new_context(**options)
    page = await context.new_page()
    wrong: list[str] = []
    page.on("console", lambda said: wrong.append(said.text) if said.type == "error" else None)
    page.on("pageerror", lambda error: wrong.append(f"{error}"))
    page.on("request", lambda asked: None if "//127.0.0.1:" in asked.url else wrong.append(asked.url))
    try:
        yield page
        assert wrong == [], wrong
    finally:
        await context.close()
