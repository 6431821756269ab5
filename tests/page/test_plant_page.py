"""The page of a plant: what boxes publish, waveforms while somebody looks, and commands over the broker."""

from __future__ import annotations

import asyncio
import json
import re
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING, Any

import pytest
from support.browsers import browsing, page_served, tab
from support.page_client import PASSWORD, Client, audited
from support.page_rig import live_rig
from support.waiting import PATIENCE_S, eventually

from daqsvc.page.access.accounts import account_line, write_account
from daqsvc.page.access.role import Role
from daqsvc.page.plant.plant_file import PlantFileError, read_plant_file
from daqsvc.publish.looking import Looking

if TYPE_CHECKING:
    from collections.abc import AsyncIterator
    from pathlib import Path

    from support.brokers import Mosquitto

    from daqsvc.service import Service

pytestmark = pytest.mark.integration
ALARM = "rotor-fault"
NAME = "demo:virtual:laval-rig"
MACHINE = f"/machines/{NAME}"
PATIENCE_MS = 1000.0 * PATIENCE_S


def plant_file(tmp_path: Path, port: int) -> Path:
    file = tmp_path / "plant.toml"
    file.write_text(f'[mqtt]\nurl = "mqtt://127.0.0.1:{port}"\ninsecure = true\n')
    return file


def box_table(port: int, **others: Any) -> dict[str, Any]:
    return {"url": f"mqtt://127.0.0.1:{port}", "insecure": True} | others


@asynccontextmanager
async def plant(
    tmp_path: Path, broker: Mosquitto, channel: str, **others: Any
) -> AsyncIterator[tuple[Service, str]]:
    """A box whose rotor goes through the paper's faults, and the page of its plant."""
    async with (
        live_rig(tmp_path / "store", channel, faulty=True, mqtt=box_table(broker.port, **others)) as service,
        page_served("--plant", plant_file(tmp_path, broker.port)) as (address, _),
    ):
        yield service, address


def live_pieces(broker: Mosquitto) -> int:
    """How many pieces of live feeds the broker has got."""
    return len(re.findall(r"Received PUBLISH from .*/live/[^/]+/feed'", broker.log_text))


async def test_a_plant_shows_a_box_and_its_waveforms_while_somebody_looks(
    tmp_path: Path, mosquitto: Mosquitto
) -> None:
    async with (
        plant(tmp_path, mosquitto, "plant-live", live={}) as (service, address),
        browsing() as browser,
        tab(browser) as page,
    ):
        await page.goto(address)
        await page.locator(".tile a").first.wait_for(timeout=PATIENCE_MS)
        assert await page.locator(".tile a").inner_text() == "laval-rig"
        assert "demo, virtual" in await page.locator(".tile").inner_text()
        assert live_pieces(mosquitto) == 0, "nothing is sent for nobody"
        for elsewhere in ({}, {"before_bytes": 1000}):
            looking = service.look(None, (), **elsewhere)
            assert isinstance(looking, Looking)
            first = json.loads((await looking.lines()).splitlines()[0])
            assert ("folder" in first) == (elsewhere == {}), "no path goes to the broker"
            looking.leave()

        await page.goto(f"{address}{MACHINE}/orbit")
        await page.locator("#rows tr:nth-child(4)").first.wait_for(timeout=PATIENCE_MS)
        await page.locator("body:not(.stale)").first.wait_for(timeout=PATIENCE_MS)
        shown = dict(re.findall(r"^(.+?)\t([\d.]+)", await page.locator("#rows").inner_text(), re.MULTILINE))
        assert shown, "the orbit in figures"
        assert len(service.watches["laval-rig"].live._lookers) == 1
        await page.goto(f"{address}{MACHINE}")
        await page.locator("#findings tbody", has_text="finds").first.wait_for(timeout=PATIENCE_MS)
        await page.locator("#alarms tbody", has_text=ALARM).first.wait_for(timeout=PATIENCE_MS)

        await page.goto("about:blank")
        lookers = service.watches["laval-rig"].live._lookers
        await eventually(lambda: not lookers, "the box sends no more")
        sent = live_pieces(mosquitto)
        await asyncio.sleep(1.5)
        assert live_pieces(mosquitto) == sent > 5


@pytest.mark.long
async def test_without_a_table_for_it_alarms_and_diagnoses_are_shown_and_it_says_so(
    tmp_path: Path, mosquitto: Mosquitto
) -> None:
    async with (
        plant(tmp_path, mosquitto, "plant-poor") as (_, address),
        browsing() as browser,
        tab(browser) as page,
    ):
        await shows(Client(address), MACHINE, "laval-rig")
        await page.goto(f"{address}{MACHINE}")
        await page.locator("#alarms tbody", has_text=ALARM).first.wait_for(timeout=PATIENCE_MS)
        assert "[mqtt.live]" in await page.locator("#head").inner_text()
        said = page.locator("#machine tbody", has_text="rotor-bank")
        await said.first.wait_for(timeout=PATIENCE_MS)
        assert live_pieces(mosquitto) == 0


@pytest.mark.long
async def test_a_viewer_too_many_is_told_so_and_has_its_turn_later(
    tmp_path: Path, mosquitto: Mosquitto
) -> None:
    table = box_table(mosquitto.port, live={"max_viewers": 1})
    file = plant_file(tmp_path, mosquitto.port)
    async with (
        live_rig(tmp_path / "store", "plant-turn", faulty=False, mqtt=table) as service,
        page_served("--plant", file) as (second, _),
        browsing() as browser,
        tab(browser) as page,
    ):
        viewers = service.watches["laval-rig"].live._lookers
        async with page_served("--plant", file) as (first, _), tab(browser) as other:
            await shows(Client(first), MACHINE, "laval-rig")
            await other.goto(f"{first}{MACHINE}/orbit")
            await eventually(lambda: len(viewers) == 1, "one looks")
            await shows(Client(second), MACHINE, "laval-rig")
            await page.goto(f"{second}{MACHINE}")
            refused = page.locator("#head", has_text="max_viewers")
            await refused.wait_for(timeout=PATIENCE_MS)
            await other.goto("about:blank")
        await page.locator("#values", has_text="probe-x").wait_for(timeout=PATIENCE_MS)
        await refused.wait_for(state="detached", timeout=PATIENCE_MS)


@pytest.mark.long
async def test_a_box_and_a_broker_that_go_are_plain_to_see_and_come_back(
    tmp_path: Path, mosquitto: Mosquitto
) -> None:
    table = box_table(mosquitto.port, live={})
    async with (
        page_served("--plant", plant_file(tmp_path, mosquitto.port), may_say="MQTT broker 127.0.0.1:") as (
            address,
            _,
        ),
        browsing() as browser,
        tab(browser) as page,
    ):
        await page.goto(address)
        async with live_rig(tmp_path / "store", "plant-away", faulty=False, mqtt=table):
            await page.locator(".tile a").first.wait_for(timeout=PATIENCE_MS)
            await page.goto(f"{address}{MACHINE}")
            await page.locator("#machine tbody", has_text="rotor-bank").first.wait_for(timeout=PATIENCE_MS)
            mosquitto.stop()
            await page.locator("#silence", has_text="is away").first.wait_for(timeout=PATIENCE_MS)
            mosquitto.start()
            await page.locator("body:not(.stale)").first.wait_for(timeout=PATIENCE_MS)
        await page.locator("#silence", has_text="the box is offline").first.wait_for(timeout=PATIENCE_MS)
        await page.goto(address)
        assert "offline" in await page.locator(".tile").inner_text()
        assert await page.locator(".tile .level").inner_text() == "unknown"


@pytest.mark.long
async def test_an_operator_acknowledges_over_the_broker_and_a_viewer_is_written_down(
    tmp_path: Path, mosquitto: Mosquitto
) -> None:
    accounts, store = tmp_path / "accounts", tmp_path / "store"
    for name, role in (("ann", Role.OPERATOR), ("bob", Role.VIEWER)):
        write_account(accounts, name, account_line(name, role, PASSWORD))
    table = box_table(mosquitto.port, commands={"enabled": True, "allow": ["acknowledge"]})
    async with (
        live_rig(store, "plant-commands", faulty=True, mqtt=table) as service,
        page_served("--plant", plant_file(tmp_path, mosquitto.port), "--accounts", accounts) as (address, _),
    ):
        alarms = service.alarms.managers["laval-rig"].alarms
        await eventually(lambda: ALARM in alarms and alarms[ALARM].state.is_active, "the alarm stands")
        client = Client(address)
        for name, state in (("bob", "active_unacknowledged"), ("ann", "active_acknowledged")):
            client.cookie = ""
            await client.sign_in(name)
            there = await shows(client, f"{MACHINE}/alarms?alarm={ALARM}", "not acknowledged")
            found = re.search(r'name="token" value="(\w+)"', there)
            assert found is not None
            fields = {"token": found[1], "verb": "acknowledge", "alarm": ALARM, "reason": "seen"}
            answer = await client.post(
                f"{MACHINE}/alarms",
                fields,
            )
            said = (await client.get(answer.headers["location"])).text
            assert ("is acknowledged by ann" in said) == (name == "ann"), said
            assert ("this person is a viewer" in said) == (name == "bob"), said
            assert alarms[ALARM].state == state
        written = [(line["by"], line["outcome"]) for line in audited(store) if line["by"] in {"ann", "bob"}]
        assert [one for one in written if one[1] != "asked"] == [("bob", "refused"), ("ann", "accepted")]


async def shows(client: Client, path: str, text: str) -> str:
    """The page at a path, as soon as it has a text."""
    async with asyncio.timeout(PATIENCE_S):
        while True:
            answer = await client.get(path)
            if answer.status == 200 and text in answer.text:
                return answer.text
            await asyncio.sleep(0.1)


def test_a_plant_file_that_cannot_be_used_says_why(tmp_path: Path) -> None:
    file = tmp_path / "plant.toml"
    for text, words in (
        ("", "no table [mqtt]"),
        ('[mqtt]\nurl = "mqtt://broker"\n', "insecure = true"),
        ('[mqtt]\nurl = "http://broker"\n', "mqtts://broker.example:8883"),
        ('[mqtt]\nurl = "mqtts://broker"\nurll = 1\n', "mqtt.urll: there is no such key"),
        ("[mqtt\n", "plant.toml"),
    ):
        file.write_text(text)
        with pytest.raises(PlantFileError, match=re.escape(words)):
            read_plant_file(file)
    file.write_text('[mqtt]\nurl = "mqtts://broker"\nca_file = "ca.pem"\n[mqtt.commands]\nenabled = true\n')
    assert read_plant_file(file).ca_file == tmp_path / "ca.pem"
    assert json.dumps(read_plant_file(file).host) == '"broker"'
