"""Pictures of every page, light and dark, wide and on a phone, kept as files of the run."""

from __future__ import annotations

import asyncio
import os
from pathlib import Path
from typing import Any

import pytest
from support.browsers import browsing, page_served, tab
from support.page_rig import live_rig
from support.paths import ROOT
from support.waiting import PATIENCE_S

from daqsvc.page.views.all_views import VIEWS

pytestmark = [pytest.mark.integration, pytest.mark.long]
SHOTS = Path(os.environ.get("DAQSVC_SHOTS", ROOT / "build" / "page-shots"))
WIDTHS = {"wide": 1280, "phone": 360}
LEAST_BYTES = 8000
"""Of a picture on which there is something."""
LOOKED_FOR = "#figures canvas, #figures .bk-Figure, #figures div[id]"


@pytest.mark.parametrize("scheme", ["light", "dark"])
async def test_every_page_has_its_picture(scheme: Any, tmp_path: Path) -> None:
    await asyncio.to_thread(SHOTS.mkdir, parents=True, exist_ok=True)
    paths = {
        "machine": "",
        "alarms": "/alarms",
        "snapshots": "/snapshots",
        "detectability": "/detectability",
    } | {name: f"/{name}" for name in VIEWS}
    async with (
        live_rig(tmp_path / "store", f"page-shots-{scheme}", faulty=True),
        page_served("--store", tmp_path / "store") as (address, _),
        browsing() as browser,
        tab(browser, color_scheme=scheme) as page,
    ):
        machine = f"{address}/machines/laval-rig"
        await page.goto(machine)
        await page.locator("#findings").get_by_text("rotor-bank finds").wait_for(timeout=1000.0 * PATIENCE_S)
        for width_name, width in WIDTHS.items():
            await page.set_viewport_size({"width": width, "height": 900})
            for name, path in {"plant": None, **paths}.items():
                await page.goto(address if path is None else f"{machine}{path}")
                absent = await page.get_by_text("There is no such view of this machine").count()
                if name == "machine":
                    await page.locator("#values tbody tr").first.wait_for(timeout=1000.0 * PATIENCE_S)
                    await page.wait_for_timeout(1200)  # for its figure
                if name in VIEWS and not absent:
                    await page.locator(LOOKED_FOR).first.wait_for(timeout=1000.0 * PATIENCE_S)
                    await page.wait_for_timeout(1200)  # for its data
                shot = SHOTS / f"{name}-{scheme}-{width_name}.png"
                await page.screenshot(path=shot, full_page=True)
                assert shot.stat().st_size > LEAST_BYTES, shot.name
    made = await asyncio.to_thread(lambda: {path.name for path in SHOTS.glob(f"*-{scheme}-*.png")})
    assert {f"{name}-{scheme}-{width}.png" for name in (*paths, "plant") for width in WIDTHS} <= made
