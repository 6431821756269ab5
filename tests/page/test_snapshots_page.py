"""Snapshots of the recorder in the page of the service: listed, opened, and one beside the other."""

from __future__ import annotations

import asyncio
import contextlib
import re
import time
from typing import TYPE_CHECKING

import pytest
from support.browsers import browsing, page_served, tab
from support.recorded_rig import RATE_HZ, let_time_pass, play, recorded_rig, recorder_of, recording
from support.waiting import PATIENCE_S, eventually
from test_handling import Client

from daqsvc.page.box_snapshots import MOST_OPEN, BoxSnapshots, KeptSnapshot
from daqsvc.page.recorded import NoPictureError
from daqsvc.page.server import _stood

if TYPE_CHECKING:
    from pathlib import Path

pytestmark = [pytest.mark.integration, pytest.mark.long]
PATIENCE_MS = 1000.0 * PATIENCE_S


async def test_a_snapshot_opens_beside_a_healthy_one(tmp_path: Path) -> None:
    store = tmp_path / "store"
    machine, samples = recorded_rig("page-beside", before_s=3.0, after_s=1.0)
    async with recording(machine, store) as (service, clock):
        await play(service, clock, samples[: round(1.5 * RATE_HZ) // 3 * 3])
        asked = asyncio.create_task(recorder_of(service).snapshot("healthy"))
        await let_time_pass(service, clock, 6.0)
        await asked
        await play(service, clock, samples[round(1.5 * RATE_HZ) // 3 * 3 : round(6.5 * RATE_HZ) // 3 * 3])
        await let_time_pass(service, clock, 12.0)
        folder = recorder_of(service).folder.directory
        paths = sorted(await asyncio.to_thread(lambda: list(folder.glob("*.mcap"))))
        [healthy] = [path for path in paths if path.stem.endswith("-asked")]
        faulty = next(path for path in paths if path.stem.endswith("-alarm"))
        async with (
            page_served("--store", store) as (address, _),
            browsing() as browser,
            tab(browser) as page,
        ):
            client = Client(address)
            for name in ("none", "..%2f..", f"x%2f{faulty.stem}", f"{faulty.stem}.mcap", f"..@{faulty.stem}"):
                begun_s = time.monotonic()
                answer = await client.get(f"/machines/laval-rig@{name}")
                assert (answer.status, time.monotonic() - begun_s < 2.5) == (404, True), name
                assert f"{tmp_path}" not in answer.text
            assert (await client.get("/machines/nobody")).status == 404
            framed = (await client.get("/beside?left=../..&right=%22%3E%3Cb%3E")).text
            assert 'src="/machines/..%2F.."' in framed
            assert "<b>" not in framed
            assert "Nothing is named to be shown" in (await client.get("/beside")).text

            await page.goto(f"{address}/machines/laval-rig/snapshots")
            assert await page.locator("#snapshots tbody tr").count() == len(paths)
            await (
                page.locator("#snapshots").get_by_role("row", name="alarm").get_by_role("link").first.click()
            )
            row = page.locator("#alarms").get_by_role("row", name="rotor-fault")
            await row.wait_for(timeout=PATIENCE_MS)
            assert "rotor-bank finds" in await row.inner_text()
            await page.get_by_role("link", name="Alarms", exact=True).click()
            assert await page.get_by_role("button", name="Acknowledge").count() == 0

            await page.goto(f"{address}/machines/laval-rig/snapshots")
            assert await page.locator("select[name=right]").input_value() == f"laval-rig@{healthy.stem}"
            await page.locator("select[name=left]").select_option(f"laval-rig@{faulty.stem}")
            await page.get_by_role("button", name="Show both").click()
            sizes = []
            for name in (faulty.stem, healthy.stem):
                frame = page.frame_locator(f'iframe[title="laval-rig@{name}"]')
                cell = frame.get_by_role("row", name=re.compile(r"^1X x \d"))
                await cell.wait_for(timeout=PATIENCE_MS)
                sizes.append(float((await cell.inner_text()).split("\t")[1]))
            assert min(sizes) > 10.0


async def test_few_snapshots_are_held_at_a_time_and_what_is_looked_at_stays(tmp_path: Path) -> None:
    store = tmp_path / "store"
    machine, samples = recorded_rig("page-few", before_s=1.0, after_s=0.5)
    async with recording(machine, store) as (service, clock):
        await play(service, clock, samples[: round(1.5 * RATE_HZ) // 3 * 3])
        for number in range(MOST_OPEN + 2):
            asked = asyncio.create_task(recorder_of(service).snapshot(f"number {number}"))
            await let_time_pass(service, clock, 4.0)
            await asked
        kept = BoxSnapshots(store)
        names = [one.name for one in kept.kept("laval-rig")]
        assert len(names) == MOST_OPEN + 2
        assert kept.kept("../store") == []
        async with kept.looking(names[0]) as first:
            for name in names[1:]:
                async with kept.looking(name):
                    pass
            async with kept.looking(names[0]) as again:
                assert again is first
        assert len(kept._open) <= MOST_OPEN
        async with contextlib.AsyncExitStack() as all_of_them:
            for name in names[:MOST_OPEN]:
                await all_of_them.enter_async_context(kept.looking(name))
            with pytest.raises(NoPictureError, match="close one"):
                await all_of_them.enter_async_context(kept.looking(names[MOST_OPEN]))
        await eventually(lambda: not kept._open, "none is played when nobody looks")
        with pytest.raises(KeyError):
            async with kept.looking("laval-rig@20260101T000000.000000Z-alarm"):
                pass
        await kept.close()


def test_a_snapshot_in_which_an_alarm_stood_is_no_healthy_one() -> None:
    at = KeptSnapshot("rig@x", "2026-11-26T12:00:00Z", "scheduled", 1.0)
    noon_ns = 1_795_694_400_000_000_000
    raised = {"alarm": "a", "level": "alert", "wall_ns": noon_ns - 2_000_000_000}
    returned = {"alarm": "a", "level": "normal", "wall_ns": noon_ns - 1_000_000_000}
    later = {"alarm": "a", "level": "danger", "wall_ns": noon_ns + 1_000_000_000}
    assert _stood([raised], at)
    assert not _stood([later, returned, raised], at)
    assert not _stood([], at)
