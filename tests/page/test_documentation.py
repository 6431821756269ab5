"""The documentation beside the page: its files, their policy, the search, and what is said without it."""

from __future__ import annotations

import asyncio
import contextlib
import http.client
import socket
from base64 import b64encode
from hashlib import sha256
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
import uvicorn
from support.browsers import browsing, tab
from support.docs_site import built_docs
from support.paths import ROOT
from support.waiting import PATIENCE_S

from daqsvc.page.documentation import PLACES, built_site
from daqsvc.page.server import application
from daqsvc.page.source import BoxSource

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

pytestmark = pytest.mark.integration
INLINE = "document.body.dataset.theme = 'auto';"


@contextlib.asynccontextmanager
async def served(store: Path, documentation: Path | None) -> AsyncIterator[str]:
    """The page of a box with this documentation; its address."""
    app = application(BoxSource(store), documentation=documentation)
    server = uvicorn.Server(uvicorn.Config(app, log_level="warning"))
    with socket.create_server(("127.0.0.1", 0)) as listening:
        running = asyncio.create_task(server.serve(sockets=[listening]))
        try:
            yield f"http://127.0.0.1:{listening.getsockname()[1]}"
        finally:
            server.should_exit = True
            await running
            await app.state.close()


async def ask(address: str, path: str) -> tuple[int, str, http.client.HTTPMessage]:
    def get() -> tuple[int, str, http.client.HTTPMessage]:
        connection = http.client.HTTPConnection(address.removeprefix("http://"), timeout=60)
        with contextlib.closing(connection):
            connection.request("GET", path)
            answer = connection.getresponse()
            return answer.status, answer.read().decode("latin-1"), answer.headers

    return await asyncio.to_thread(get)


@pytest.fixture
def small(tmp_path: Path) -> Path:
    """A site of a page and a script."""
    folder = tmp_path / "html"
    folder.mkdir()
    (folder / "index.html").write_text(f'<body><script>{INLINE}</script><script src="a.js"></script>')
    (folder / "a.js").write_text("")
    (tmp_path / "secret.txt").write_text("of the box")
    return folder


async def test_its_files_are_served_with_a_policy_that_lets_its_own_scripts_run(small: Path) -> None:
    async with served(small.parent, small) as address:
        status, text, headers = await ask(address, "/docs/")
        assert (status, INLINE in text) == (200, True)
        digest = b64encode(sha256(INLINE.encode()).digest()).decode()
        assert f"script-src 'self' 'sha256-{digest}';" in headers["content-security-policy"]
        assert len(headers.get_all("content-security-policy", [])) == 1
        assert headers["x-content-type-options"] == "nosniff"
        assert (await ask(address, "/docs"))[2]["location"].endswith("/docs/")
        status, _, headers = await ask(address, "/docs/a.js")
        assert (status, headers["content-type"].partition(";")[0]) == (200, "text/javascript")
        for outside in ("/docs/../secret.txt", "/docs/..%2fsecret.txt", "/docs/none.html"):
            status, text, headers = await ask(address, outside)
            assert (status, "of the box" in text) == (404, False)
            assert "sha256" not in headers["content-security-policy"]
        _, text, headers = await ask(address, "/")
        assert '<a href="/docs/">Documentation</a>' in text
        assert "script-src 'self';" in headers["content-security-policy"], "the page itself has none inline"


async def test_without_it_there_is_no_link_and_a_sentence_says_how_to_get_it(tmp_path: Path) -> None:
    async with served(tmp_path, None) as address:
        assert "/docs/" not in (await ask(address, "/"))[1]
        for path in ("/docs/", "/docs/alarms.html"):
            status, text, _ = await ask(address, path)
            assert status == 404
            assert "the Debian package brings it, and in a tree of the sources make docs makes it" in text


def test_it_is_looked_for_in_the_tree_and_then_where_the_package_has_it(
    small: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert PLACES[1] == Path("/usr/share/doc/daqsvc/html")
    monkeypatch.setattr("daqsvc.page.documentation.PLACES", (tmp_path / "none", small))
    assert built_site() == small
    (small / "index.html").unlink()
    assert built_site() is None


@pytest.mark.sources
def test_in_a_tree_it_is_where_make_docs_has_made_it() -> None:
    assert PLACES[0] == ROOT / "build" / "docs" / "html"
    assert "\nDOCS := build/docs/html\n" in (ROOT / "Makefile").read_text("utf-8")


@pytest.mark.long
@pytest.mark.sources
async def test_its_search_finds_a_word_in_a_browser(
    tmp_path: Path, tmp_path_factory: pytest.TempPathFactory
) -> None:
    site = await asyncio.to_thread(built_docs, tmp_path_factory)
    async with served(tmp_path, site) as address, browsing() as browser, tab(browser) as page:
        page.set_default_timeout(1000.0 * PATIENCE_S)
        await page.goto(address)
        await page.get_by_role("link", name="Documentation").click()
        await page.get_by_role("heading", name="The documentation of daqsvc").wait_for()
        assert await page.locator("body").get_attribute("data-theme") == "auto", "its inline script has run"
        await page.get_by_role("textbox", name="Search").fill("keyphasor")
        await page.keyboard.press("Enter")
        found = page.locator("#search-results li a[href^='order-change.html']").first
        await found.click()
        await page.get_by_role("heading", name="Has 1X changed?").wait_for()
        assert page.url.startswith(f"{address}/docs/order-change.html")
