"""The page in a real browser: what it shows of a running service, and what it says when that is gone."""

from __future__ import annotations

import asyncio
import base64
import contextlib
import json
import math
import re
import time
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from axe_playwright_python.async_playwright import Axe
from support.bearing_signals import BALL, CAGE, INNER, OUTER, SPEED_RPM, healthy, knocks
from support.browsers import browsing, page_served, tab
from support.live_service import running, watch_of
from support.page_rig import live_rig
from support.recorded_rig import RATE_HZ, let_time_pass, play, recorded_rig, recorder_of, recording
from support.waiting import PATIENCE_S, eventually

from daqsvc.alarms.commands import AlarmCommand, Verb
from daqsvc.control import SOCKET
from daqsvc.history.file import NAME as HISTORY
from daqsvc.history.file import HistoryFile, Series
from daqsvc.history.points import RECORD

if TYPE_CHECKING:
    from pathlib import Path

    from playwright.async_api import Page


pytestmark = [pytest.mark.integration, pytest.mark.long]

VIEWS = (
    *("modes", "evidence", "orbit", "centreline", "poincare", "timebase"),
    *("spectrum", "full-spectrum", "envelope", "trend"),
    *("waterfall", "bode", "polar"),
)
PATIENCE_MS = 1000.0 * PATIENCE_S
NUMBER = re.compile(r"-?\d+(\.\d+)?(e-?\d+)?")


async def figures(page: Page) -> dict[str, float]:
    """The table beside a view: what, and the number."""
    told = await page.evaluate(
        "[...document.querySelectorAll('#rows tr')].map(row => [...row.cells].map(one => one.textContent))"
    )
    return {cells[0]: float(cells[1]) for cells in told if NUMBER.fullmatch(cells[1])}


async def until_figures(page: Page, *names: str) -> dict[str, float]:
    async with asyncio.timeout(PATIENCE_S):
        while not (told := await figures(page)).keys() >= {*names}:
            await asyncio.sleep(0.1)
    return told


async def test_every_view_shows_the_numbers_of_the_machine(tmp_path: Path) -> None:
    store = tmp_path / "store"
    store.mkdir()
    now_s = int(time.time())
    points = np.array([(now_s - 600 + k, 1, 40.0, 41.0, 43.0) for k in range(600)], RECORD)
    history = HistoryFile(store / HISTORY)
    history.write({Series("laval-rig", "levels/probe-x", "level", "rms", "um"): points})
    history.close()
    async with (
        live_rig(store, "page-views", faulty=False) as service,
        page_served("--store", store) as (address, _),
        browsing() as browser,
        tab(browser) as page,
    ):
        ring = watch_of(service).rings["shaft"]
        await eventually(lambda: ring.end_index > 5 * RATE_HZ, "some seconds have come")
        machine = f"{address}/machines/laval-rig"

        # At its natural frequency a Laval rotor whirls with e / (2 zeta), 90 degrees behind the heavy spot.
        whirl_um = 10.0 / (2.0 * 0.18)
        await page.goto(f"{machine}/orbit?revolutions=16")
        told = await until_figures(page, "1X x behind the mark")
        assert told["1X x"] == pytest.approx(whirl_um, rel=0.2)
        assert told["1X y"] == pytest.approx(whirl_um, rel=0.2)
        assert told["1X x behind the mark"] == pytest.approx(90.0, abs=12.0)
        assert told["1X y behind the mark"] == pytest.approx(180.0, abs=12.0)
        assert told["mean y"] == pytest.approx(-10.0, abs=4.0), "the static sag"
        assert told["speed"] == pytest.approx(600.0, abs=1.0)

        await page.goto(f"{machine}/full-spectrum")
        told = await until_figures(page, "1X forward", "1X backward")
        assert told["1X forward"] == pytest.approx(whirl_um, rel=0.2)
        assert told["1X backward"] < 0.3 * whirl_um, "it turns forward"

        await page.goto(f"{machine}/spectrum?sensor=probe-y")
        told = await until_figures(page, "1X at 10.00 Hz")
        assert told["1X at 10.00 Hz"] == pytest.approx(whirl_um, rel=0.2)

        await page.goto(f"{machine}/timebase?sensor=probe-x&length=5")
        told = await until_figures(page, "peak to peak")
        samples = ring.read(ring.end_index - round(5 * RATE_HZ), round(5 * RATE_HZ))[:, 0]
        assert told["rms about the mean"] == pytest.approx(float(samples.std()), rel=0.05)
        assert told["mean"] == pytest.approx(float(samples.mean()), abs=1.0)

        await page.goto(f"{machine}/centreline")
        told = await until_figures(page, "x now", "y now")
        mean = ring.read(ring.end_index - round(2 * RATE_HZ), round(2 * RATE_HZ)).mean(axis=0)
        assert [told["x now"], told["y now"]] == pytest.approx([mean[0], mean[1]], abs=5.0)

        await page.goto(f"{machine}/poincare?revolutions=20")
        told = await until_figures(page, "spread of x")
        assert told["revolutions"] == pytest.approx(20.0, abs=1.0)
        noise_um = watch_of(service).machine.pipeline.rotor_bank.noise_um  # type: ignore[attr-defined]
        assert told["spread of x"] == pytest.approx(noise_um, rel=0.6), (
            "the same each revolution, but for noise"
        )

        await page.goto(f"{machine}/waterfall?sensor=probe-y")
        told = await until_figures(page, "largest of all", "speed of the newest")
        assert told["largest of all"] == pytest.approx(whirl_um, rel=0.25)
        assert told["speed of the newest"] == pytest.approx(600.0, abs=1.0)

        for view in ("bode", "polar"):
            await page.goto(f"{machine}/{view}?sensor=probe-x")
            told = await until_figures(page, "1X now", "lag now")
            assert told["1X now"] == pytest.approx(whirl_um, rel=0.2)
            assert told["lag now"] == pytest.approx(90.0, abs=12.0)

        await page.goto(f"{machine}/trend?hours=1")
        told = await until_figures(page, "mean", "greatest")
        assert (told["mean"], told["least"], told["greatest"]) == (41.0, 40.0, 43.0)

        await page.goto(f"{machine}/modes")
        await page.get_by_role("row", name="p(N)").wait_for(timeout=PATIENCE_MS)
        said = next(one for one in service.reports["laval-rig"].latest if one.detector == "rotor-bank")
        assert said.decision == "N"
        assert await page.get_by_role("row", name="p(N)").inner_text() == "p(N)\t> 0.999\t"
        assert await page.get_by_role("row", name="decides").inner_text() == "decides\tN\t"

        await page.goto(machine)
        row = page.get_by_role("row", name="levels/probe-x")
        await row.wait_for(timeout=PATIENCE_MS)
        rms = float(re.search(r"rms ([\d.]+) um", await row.inner_text())[1])  # type: ignore[index]
        assert rms == pytest.approx(float(samples.std()), rel=0.15)
        value = await page.locator("#values").get_by_role("row", name="probe-x").inner_text()
        assert re.search(r"rms [\d.]+ um", value)
        assert "(alert 50, danger 70)" in value
        assert value.split("\t")[2:4] == ["normal", "OK"]
        await page.locator("#figures canvas, #figures .bk-Figure").first.wait_for(timeout=PATIENCE_MS)

        await page.goto(f"{machine}/evidence")
        await page.get_by_role("row", name="declared").wait_for(timeout=PATIENCE_MS)
        assert await page.get_by_role("row", name="declared").inner_text() == "declared\tN\t"

        await page.goto(f"{machine}/detectability")
        table = page.locator("#detectability")
        await table.wait_for(timeout=PATIENCE_MS)
        assert "All modes can be told apart at 600 rpm" in await table.inner_text()

        await page.goto(address)
        await page.get_by_role("link", name="laval-rig").click()
        assert page.url == machine


async def test_an_alarm_appears_and_what_is_done_about_it(tmp_path: Path) -> None:
    store = tmp_path / "store"
    async with (
        live_rig(store, "page-alarm", faulty=True) as service,
        page_served("--store", store) as (address, _),
        browsing() as browser,
        tab(browser) as page,
    ):
        await page.goto(f"{address}/machines/laval-rig")
        row = page.locator("#alarms").get_by_role("row", name="rotor-fault")
        await row.wait_for(timeout=PATIENCE_MS)
        assert "not acknowledged" in await row.inner_text()
        assert "rotor-bank finds" in await row.inner_text()
        assert await page.locator("#head .level").inner_text() in {"alert", "danger"}
        acknowledge = AlarmCommand(verb=Verb.ACKNOWLEDGE, alarm="rotor-fault", by="the test")
        assert (await service.alarms.execute(acknowledge, "test")).accepted
        await page.get_by_role("row", name="active, acknowledged").wait_for(timeout=PATIENCE_MS)
        done = page.locator("#journal").get_by_role("row", name="acknowledged")
        await done.wait_for(timeout=PATIENCE_MS)
        assert "the test" in await done.inner_text()
        await page.goto(address)
        await page.locator(".tile.danger, .tile.alert").wait_for(timeout=PATIENCE_MS)
        assert "rotor-fault first" in await page.locator(".tile").inner_text()


async def test_what_is_not_heard_any_more_is_grey_and_says_its_age(tmp_path: Path) -> None:
    store = tmp_path / "store"
    store.mkdir(mode=0o700)
    silence = "#silence:not([hidden])"
    async with browsing() as browser, page_served("--store", store) as (address, _), tab(browser) as page:
        await page.goto(address)
        assert "no daqsvc answers on this box" in await page.locator("main").inner_text()
        async with live_rig(store, "page-grey", faulty=False):
            await page.goto(f"{address}/machines/laval-rig/orbit")
            await until_figures(page, "1X x")
            assert not await page.locator(silence).count()
        await page.locator(silence).wait_for(timeout=PATIENCE_MS)
        said = await page.locator(silence).inner_text()
        why = "no daqsvc runs on the store|the service has ended the connection"
        assert re.fullmatch(rf"What is shown is \d+ s old: ({why})\.", said)
        assert "stale" in (await page.locator("body").get_attribute("class") or "")
        found = await Axe().run(page)
        wrong = [
            one["id"] for one in found.response["violations"] if one["impact"] in {"serious", "critical"}
        ]
        assert wrong == [], "what is grey is still to be read"
        async with live_rig(store, "page-grey", faulty=False):
            await page.locator(silence).wait_for(state="hidden", timeout=PATIENCE_MS)
            shown = await page.locator("#rows").inner_text()
            await page.locator(f"#rows:not(:text-is({shown!r}))").wait_for(timeout=PATIENCE_MS)


async def test_a_page_whose_server_is_gone_says_so(tmp_path: Path) -> None:
    store = tmp_path / "store"
    async with live_rig(store, "page-gone", faulty=False), browsing() as browser:
        context = await browser.new_context()
        page = await context.new_page()
        async with page_served("--store", store) as (address, _):
            await page.goto(f"{address}/machines/laval-rig/timebase")
            await until_figures(page, "mean")
            port = int(address.rpartition(":")[2])
        gone = page.get_by_text("the page's server does not answer")
        await gone.wait_for(timeout=PATIENCE_MS)
        async with page_served("--store", store, "--port", port):
            await gone.wait_for(state="hidden", timeout=PATIENCE_MS)
        await context.close()


@pytest.mark.parametrize("scheme", ["light", "dark"])
async def test_everybody_can_read_it(scheme: Any, tmp_path: Path) -> None:
    store = tmp_path / "store"
    async with (
        live_rig(store, f"page-read-{scheme}", faulty=True),
        page_served("--store", store) as (address, _),
        browsing() as browser,
        tab(browser, color_scheme=scheme) as page,
    ):
        machine = f"{address}/machines/laval-rig"
        await page.goto(machine)
        await page.locator("#alarms").get_by_text("rotor-bank finds").first.wait_for(timeout=PATIENCE_MS)
        pages = ("alarms", "alarms?alarm=rotor-fault", "snapshots", "detectability")
        for path in (address, machine, *(f"{machine}/{view}" for view in (*pages, *VIEWS))):
            await page.set_viewport_size({"width": 1280, "height": 900})
            await page.goto(path)
            await page.locator("footer").wait_for()
            if path.rpartition("/")[2] in {"laval-rig", *VIEWS}:
                await page.locator("#alarms .level").first.wait_for(timeout=PATIENCE_MS)
            found = await Axe().run(page)
            serious = [
                (one["id"], [node["target"] for node in one["nodes"]])
                for one in found.response["violations"]
                if one["impact"] in {"serious", "critical"}
            ]
            assert serious == [], path
            # A phone, and a screen of 1280 pixels that is enlarged fourfold.
            for width in (360, 320):
                await page.set_viewport_size({"width": width, "height": 640})
                async with asyncio.timeout(PATIENCE_S):  # figures follow a moment later
                    while await page.evaluate("document.documentElement.scrollWidth") > width:
                        await asyncio.sleep(0.05)
            await page.screenshot(path=tmp_path / "shot.png", full_page=True)


async def test_figures_stand_still_when_they_are_frozen(tmp_path: Path) -> None:
    store = tmp_path / "store"
    async with (
        live_rig(store, "page-freeze", faulty=False),
        page_served("--store", store) as (address, _),
        browsing() as browser,
        tab(browser) as page,
    ):
        await page.goto(f"{address}/machines/laval-rig/orbit")
        await until_figures(page, "1X x")
        await page.get_by_role("button", name="Freeze").click()
        assert "frozen since" in await page.locator("#silence").inner_text()
        shown = await page.locator("#rows").inner_text()
        await asyncio.sleep(0.5)
        assert await page.locator("#rows").inner_text() == shown
        await page.get_by_role("button", name="Freeze").click()
        await page.locator(f"#rows:not(:text-is({shown!r}))").wait_for(timeout=PATIENCE_MS)
        # The choice is in the address, and the address can be shared.
        await page.get_by_label("Length").select_option("16")
        await page.get_by_role("button", name="Show").click()
        await page.wait_for_url("**/orbit?probes=probe-x%2Cprobe-y&revolutions=16")
        assert await page.get_by_label("Length").input_value() == "16"
        assert math.isclose((await until_figures(page, "speed"))["speed"], 600.0, abs_tol=1.0)


async def test_a_machine_of_which_nothing_comes_is_not_shown_as_a_service_that_is_gone(
    tmp_path: Path,
) -> None:
    machine = recorded_rig("page-silent")[0].model_copy(update={"recorder": None})
    async with (
        running(machine, tmp_path / "store"),
        page_served("--store", tmp_path / "store") as (address, _),
        browsing() as browser,
        tab(browser) as page,
    ):
        await page.goto(f"{address}/machines/laval-rig/orbit")
        await page.get_by_text("no samples of these probes have come yet").wait_for(timeout=PATIENCE_MS)
        for _ in range(50):
            assert not await page.locator("#silence:not([hidden])").count(), "the service is there"
            await asyncio.sleep(0.1)


async def test_a_snapshot_is_played_in_the_same_views(tmp_path: Path) -> None:
    machine, samples = recorded_rig("page-snapshot", before_s=3.0, after_s=1.0)
    async with recording(machine, tmp_path / "store") as (service, clock):
        await play(service, clock, samples[: round(6.5 * RATE_HZ) // 3 * 3])
        await let_time_pass(service, clock, 12.0)
        folder = recorder_of(service).folder.directory
    [path, *_] = sorted(await asyncio.to_thread(lambda: list(folder.glob("*-alarm.mcap"))))
    async with (
        page_served("--snapshot", path) as (address, _),
        browsing() as browser,
        tab(browser) as page,
    ):
        await page.goto(address)
        await page.get_by_role("link", name=path.stem).click()
        row = page.locator("#alarms").get_by_role("row", name="rotor-fault")
        await row.wait_for(timeout=PATIENCE_MS)
        assert "rotor-bank finds" in await row.inner_text()
        await page.get_by_role("link", name="Orbit").click()
        told = await until_figures(page, "1X x")
        assert 15.0 < told["1X x"] < 100.0


async def test_the_envelope_of_a_damaged_bearing_shows_its_outer_race(tmp_path: Path) -> None:
    store = tmp_path / "store"
    store.mkdir()
    samples = healthy(4.0, seed=5) + knocks(4.0, OUTER, seed=6)
    orders = {"bpfi": INNER, "bpfo": OUTER, "bsf": BALL / 2.0, "ftf": CAGE}
    about = {
        "schema": "daqsvc.live/1",
        "machine": "fan",
        "begun_ns": 0,
        "wall_ns_at_0": time.time_ns(),
        "streams": {"de": {"rate_hz": 12_000.0, "channels": ["a"], "sensors": ["de"], "units": ["g"]}},
        "values": {
            "machine": {"name": "fan", "speed_rpm": SPEED_RPM},
            "sensors": [{"name": "de", "type": "accelerometer", "unit": "g"}],
            "pipeline": {"bearing": {"bearings": [{"name": "", "sensor": "de", "orders": orders}]}},
        },
        "statements": [],
        "alarms": [],
        "standings": {},
    }
    values = base64.b64encode(samples.astype("<f4").tobytes()).decode()
    facts = {"stream": "de", "first_index": 0, "t_first_ns": 0, "period_ns": 1e9 / 12_000.0, "lost_before": 0}
    told = {"samples": facts | {"quality": 0, "shape": [len(samples), 1], "values": values}}

    async def answer(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        wanted = json.loads(await reader.readline())["streams"]
        writer.write(json.dumps(about).encode() + b"\n")
        if "de" in wanted:
            writer.write(json.dumps(told).encode() + b"\n")
        with contextlib.suppress(ConnectionError):
            while not reader.at_eof():
                writer.write(b'{"alive":true}\n')
                await writer.drain()
                await asyncio.sleep(0.3)
        writer.close()

    async with (
        await asyncio.start_unix_server(answer, store / SOCKET),
        page_served("--store", store) as (address, _),
        browsing() as browser,
        tab(browser) as page,
    ):
        await page.goto(f"{address}/machines/fan/envelope?length=2")
        outer_hz, inner_hz = OUTER * SPEED_RPM / 60.0, INNER * SPEED_RPM / 60.0
        names = f"BPFO, {outer_hz:.1f} Hz", f"BPFI, {inner_hz:.1f} Hz"
        shown = await until_figures(page, *names)
        assert shown[names[0]] > 3.0 * shown[names[1]]
        assert await page.locator("#rows tr", has_text="largest at").count() == 1
        await page.goto("about:blank")


async def test_everything_is_reached_by_the_keyboard(tmp_path: Path) -> None:
    store = tmp_path / "store"
    async with (
        live_rig(store, "page-keys", faulty=False),
        page_served("--store", store) as (address, _),
        browsing() as browser,
        tab(browser) as page,
    ):
        await page.goto(f"{address}/machines/laval-rig/spectrum")
        await until_figures(page, "1X at 10.00 Hz")
        await page.keyboard.press("Tab")
        focused = page.locator(":focus")
        assert await focused.inner_text() == "Skip to the content"
        assert await focused.is_visible()
        reached = []
        for _ in range(60):
            await page.keyboard.press("Tab")
            reached.append(await focused.evaluate("one => one.name || one.textContent.trim()"))
            if reached[-1] == "axis":
                await page.keyboard.press("ArrowDown")
            if reached[-1] == "Freeze":
                break
        assert {"Plant", "Alarms", "Orbit", "sensor", "cursors", "axis", "Show"} <= {*reached}
        await page.keyboard.press("Enter")
        assert "frozen" in await page.locator("#silence").inner_text()
        await page.keyboard.press("Shift+Tab")
        await page.keyboard.press("Enter")
        await page.wait_for_url("**axis=order**", timeout=PATIENCE_MS)
