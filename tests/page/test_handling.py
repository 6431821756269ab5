"""Handling alarms by the page: who may, what is written down, and what other sites cannot have done."""

from __future__ import annotations

import asyncio
import contextlib
import re
import ssl
from typing import TYPE_CHECKING, Any
from urllib.parse import parse_qs, quote, urlsplit

import pytest
from support.browsers import browsing, page_served, tab
from support.page_client import PASSWORD, Client, audited
from support.page_rig import live_rig
from support.tls_files import self_signed
from support.waiting import PATIENCE_S, eventually
from test_views import about

from daqsvc.alarms.states import Level
from daqsvc.page.access.accounts import account_line, write_account
from daqsvc.page.access.role import Role
from daqsvc.page.handling import _times, offered
from daqsvc.page.machine_live import MachineLive

if TYPE_CHECKING:
    from collections.abc import AsyncIterator
    from pathlib import Path

    from daqsvc.service import Service

pytestmark = pytest.mark.integration
ALARM = "rotor-fault"
MACHINE = "/machines/laval-rig/alarms"
PATIENCE_MS = 1000.0 * PATIENCE_S


@contextlib.asynccontextmanager
async def handled_rig(tmp_path: Path, channel: str) -> AsyncIterator[tuple[Service, Client, Path]]:
    """A service whose alarm stands, as bad as it gets, and its page with two accounts."""
    store, accounts = tmp_path / "store", tmp_path / "accounts"
    for name, role in (("ann", Role.OPERATOR), ("bob", Role.VIEWER)):
        write_account(accounts, name, account_line(name, role, PASSWORD))
    async with (
        live_rig(store, channel, faulty=True) as service,
        page_served("--store", store, "--accounts", accounts) as (address, _),
    ):
        alarms = service.alarms.managers["laval-rig"].alarms
        # An alarm that gets worse calls for a person again, whoever acknowledged it before.
        await eventually(lambda: ALARM in alarms and alarms[ALARM].level is Level.DANGER, "the alarm stands")
        yield service, Client(address), store


def wish(token: str, **others: str) -> dict[str, str]:
    return {
        "token": token,
        "verb": "acknowledge",
        "alarm": ALARM,
        "reason": "seen",
        "occurrence": "",
    } | others


async def test_an_operator_handles_an_alarm_and_a_viewer_does_not(tmp_path: Path) -> None:
    async with handled_rig(tmp_path, "page-handle") as (service, client, store):
        alarms = service.alarms.managers["laval-rig"].alarms
        state = alarms[ALARM].state

        answer = await client.get(f"{MACHINE}?alarm={ALARM}")
        assert (answer.status, answer.headers["location"]) == (
            303,
            f"/sign-in?then={quote(f'{MACHINE}?alarm={ALARM}')}",
        )
        assert (await client.get("/events/laval-rig", accept="text/event-stream")).status == 401
        assert (await client.get("/static/page.css")).status == 200
        assert (await client.get("/static/bokeh.js", accept="*/*")).status == 401
        assert (await client.post(MACHINE, wish("x"))).status == 401
        assert "name or password are wrong" in (await client.sign_in("bob", "wrong")).text

        answer = await client.sign_in("bob")
        assert (answer.status, answer.headers["location"]) == (303, MACHINE)
        cookie = answer.headers["set-cookie"].lower()
        assert "httponly" in cookie
        assert "samesite=strict" in cookie
        looked = (await client.get(f"{MACHINE}?alarm={ALARM}")).text
        assert "bob may look only" in looked
        assert "--operator-link" not in looked, "this page has accounts"
        assert "Open one to see" in (await client.get(MACHINE)).text
        assert "Acknowledge" not in looked
        token = await client.token("/")
        answer = await client.post(MACHINE, wish(token))
        assert answer.status == 303
        assert "this person is a viewer" in (await client.get(answer.headers["location"])).text
        assert alarms[ALARM].state is state
        refused = audited(store)[-1]
        assert (refused["outcome"], refused["by"], refused["verb"]) == ("refused", "bob", "acknowledge")
        assert refused["source"].endswith("page 127.0.0.1 bob")
        assert "viewer" in refused["answer"]

        ann = Client(client.address)
        await ann.sign_in("ann")
        assert (await ann.post(MACHINE, wish(token))).status == 403, "a token of somebody else"
        token = await ann.token("/")
        for headers in (
            {"origin": "http://evil.example"},
            {"origin": "null"},
            {"sec-fetch-site": "cross-site"},
            {"sec-fetch-site": "same-site"},
            {"content-type": "text/plain"},
        ):
            assert (await ann.post(MACHINE, wish(token), **headers)).status == 403, headers
        assert (await ann.send(MACHINE, b"token=" + token.encode() + b"&a=" + b"x" * 20_000)).status == 403
        assert (await ann.send(MACHINE, f"token={token}&verb=reset&verb=acknowledge".encode())).status == 403
        assert (await ann.send(MACHINE, b"token=%ff&verb=acknowledge")).status == 403
        assert alarms[ALARM].state is state, "none of these was obeyed"
        answer = await ann.post(MACHINE, wish(token, occurrence="another"))
        shown = (await ann.get(answer.headers["location"])).text
        assert re.search(r"Nothing was done: .* is over, now .* stands \[C08\]\.", shown)
        answer = await ann.post(MACHINE, wish(token, verb="shelve", hours="1", reason=" "))
        assert "give a reason for rotor-fault" in (await ann.get(answer.headers["location"])).text

        answer = await ann.post(MACHINE, wish(token, occurrence=str(alarms[ALARM].occurrence)))
        shown = (await ann.get(answer.headers["location"])).text
        assert "rotor-fault is acknowledged by ann." in shown
        assert alarms[ALARM].state.value.endswith("_acknowledged")
        assert not alarms[ALARM].state.value.endswith("unacknowledged")
        done = audited(store)[-1]
        assert (done["outcome"], done["by"], done["reason"]) == ("accepted", "ann", "seen")
        answer = await ann.post(MACHINE, wish(token, verb="shelve", hours="1", reason="test run"))
        assert "rotor-fault is shelved by ann." in (await ann.get(answer.headers["location"])).text
        shown = (await ann.get(f"{MACHINE}?alarm={ALARM}")).text
        assert "Unshelve" in shown
        assert shown.count("shelved") >= 3, "the state, and what has happened"

        assert (await ann.post("/sign-out", {"token": token})).status == 303
        assert (await ann.get(MACHINE)).status == 303, "signed out"


async def test_a_form_of_this_page_leads_nowhere_else(tmp_path: Path) -> None:
    accounts = tmp_path / "accounts"
    write_account(accounts, "ann", account_line("ann", Role.OPERATOR, PASSWORD))
    async with page_served("--store", tmp_path, "--accounts", accounts) as (address, _):
        for there in ("//evil.example/", "/\\evil.example", "https://evil.example", "/a\r\nx: y"):
            client = Client(address)
            token = await client.token("/sign-in")
            fields = {"token": token, "name": "ann", "password": PASSWORD, "then": there}
            assert (await client.post("/sign-in", fields)).headers["location"] == "/", there
        assert (await Client(address).get("/sign-in", host="evil.example")).status == 400


async def test_over_tls_the_cookie_goes_nowhere_else(tmp_path: Path) -> None:
    accounts = tmp_path / "accounts"
    write_account(accounts, "ann", account_line("ann", Role.OPERATOR, PASSWORD))
    pair = self_signed(tmp_path, "page", "127.0.0.1")
    async with page_served(
        *("--store", tmp_path, "--accounts", accounts),
        *("--certificate", pair.cert, "--private-key", pair.key),
    ) as (address, _):
        assert address.startswith("https://")
        client = Client(address, ssl.create_default_context(cafile=pair.cert))
        answer = await client.sign_in("ann")
        assert answer.status == 303
        assert "secure" in answer.headers["set-cookie"].lower()
        assert (await client.get("/")).status == 200


async def test_a_proxy_says_who_asks(tmp_path: Path) -> None:
    async with page_served(
        "--store", tmp_path, "--user-header", "X-Remote-User", "--proxy", "127.0.0.1", "--operator", "ann"
    ) as (address, _):
        client = Client(address)
        assert (await client.get("/")).status == 403
        assert (await client.get("/", **{"x-remote-user": "ann"})).status == 200


async def test_the_operators_address_lets_who_has_it_act(tmp_path: Path) -> None:
    async with page_served("--store", tmp_path, "--operator-link") as (address, process):
        assert process.stdout is not None
        said = (await process.stdout.readline()).decode()
        there = said.split()[2]
        assert there.startswith(f"{address}/operator?key=")
        client = Client(address)
        assert (await client.get("/operator?key=guessed")).status == 403
        assert not client.cookie
        answer = await client.get(there.removeprefix(address))
        assert (answer.status, answer.headers["location"]) == (303, "/")
        assert "operator" in (await client.get("/")).text


@pytest.mark.long
async def test_who_is_removed_hears_no_more(tmp_path: Path) -> None:
    async with handled_rig(tmp_path, "page-removed") as (_, client, _):
        await client.sign_in("bob")
        there = urlsplit(client.address)
        reader, writer = await asyncio.open_connection(there.hostname, there.port)
        asked = f"GET /events/laval-rig HTTP/1.1\r\nhost: {there.netloc}\r\ncookie: {client.cookie}\r\n\r\n"
        writer.write(asked.encode())
        async with asyncio.timeout(PATIENCE_S):
            while b"data: " not in await reader.readline():
                pass
            await asyncio.to_thread(write_account, tmp_path / "accounts", "bob", None)
            told = b""
            while not told.endswith(b"0\r\n\r\n"):
                piece = await reader.read(100_000)
                assert piece, "the stream has an end of its own"
                told += piece
        writer.close()
        await writer.wait_closed()


@pytest.mark.parametrize(
    ("alarm", "verbs"),
    [
        (None, ["shelve", "bypass"]),
        ({"state": "active_unacknowledged"}, ["acknowledge", "shelve", "bypass"]),
        ({"state": "latched_acknowledged"}, ["reset", "shelve", "bypass"]),
        ({"state": "latched_unacknowledged"}, ["acknowledge", "reset", "shelve", "bypass"]),
        (
            {"state": "shelved", "covered": "active_unacknowledged", "holds": ["shelved"]},
            ["acknowledge", "unshelve", "bypass"],
        ),
        (
            {"state": "out_of_service", "covered": "normal", "holds": ["out_of_service", "shelved"]},
            ["unshelve", "unbypass"],
        ),
    ],
)
def test_what_is_offered_follows_the_state(alarm: dict[str, Any] | None, verbs: list[str]) -> None:
    assert [verb.value for verb in offered(alarm)] == verbs


@pytest.mark.long
async def test_an_operator_acknowledges_an_alarm_in_the_browser(tmp_path: Path) -> None:
    async with (
        handled_rig(tmp_path, "page-browse") as (service, client, store),
        browsing() as browser,
        tab(browser) as page,
    ):
        await page.goto(f"{client.address}/machines/laval-rig")
        await page.get_by_label("Name").fill("ann")
        await page.get_by_label("Password").fill(PASSWORD)
        await page.get_by_role("button", name="Sign in").click()
        await page.wait_for_url("**/machines/laval-rig")
        await page.get_by_role("link", name="Alarms", exact=True).click()
        row = page.locator("#alarm-list").get_by_role("row", name=ALARM)
        await row.wait_for(timeout=PATIENCE_MS)
        assert "active, not acknowledged" in await row.inner_text()
        await row.get_by_role("link").click()
        form = page.locator("form", has=page.get_by_role("button", name="Acknowledge"))
        await form.get_by_label("Reason").fill("on my way")
        await form.get_by_role("button").click()
        await page.get_by_text("rotor-fault is acknowledged by ann.").wait_for(timeout=PATIENCE_MS)
        assert service.alarms.managers["laval-rig"].alarms[ALARM].state.value == "active_acknowledged"
        done = audited(store)[-1]
        assert (done["by"], done["reason"], done["outcome"]) == ("ann", "on my way", "accepted")
        assert parse_qs(urlsplit(page.url).query)["alarm"] == [ALARM]
        await page.get_by_role("link", name="All alarms").click()
        await page.get_by_role("row", name="active, acknowledged").wait_for(timeout=PATIENCE_MS)
        await page.get_by_role("button", name="Sign out").click()
        await page.get_by_role("button", name="Sign in").wait_for()


@pytest.mark.parametrize(
    ("handling", "times"),
    [
        ({}, ["1", "4", "8"]),
        ({"shelve_at_most_s": 86_400.0}, ["1", "4", "8", "24"]),
        ({"shelve_at_most_s": 60.0}, ["1"]),
    ],
)
def test_an_alarm_is_shelved_no_longer_than_the_machine_file_allows(handling: Any, times: list[str]) -> None:
    live = MachineLive(about())
    live.values = live.values | {"alarm_handling": handling}
    assert list(_times(live)) == times
