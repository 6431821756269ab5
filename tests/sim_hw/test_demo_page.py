"""The demo in a browser: an address while it plays, and playing again until it is enough."""

from __future__ import annotations

import argparse
import asyncio
import json
import sys
import urllib.request
from typing import TYPE_CHECKING

import pytest
from support.waiting import PATIENCE_S, eventually

from sim_hw.demo.command import DemoCommand, script_of
from sim_hw.demo.session import DemoSession

if TYPE_CHECKING:
    from sim_hw.demo.session import Received

pytestmark = pytest.mark.integration


def get(address: str) -> str:
    with urllib.request.urlopen(address, timeout=PATIENCE_S) as answer:  # noqa: S310 - of this computer
        text: str = answer.read().decode()
    return text


@pytest.mark.long
async def test_the_demo_says_where_its_page_is_and_takes_it_along() -> None:
    demo = await asyncio.create_subprocess_exec(
        *(sys.executable, "-m", "daqsvc", "demo", "--json", "--page", "--speed", "2"),
        stdout=asyncio.subprocess.PIPE,
    )
    assert demo.stdout is not None
    async with asyncio.timeout(PATIENCE_S):
        told = json.loads(await demo.stdout.readline())
        assert told["type"] == "page"
        while json.loads(await demo.stdout.readline())["type"] != "diagnosis":
            pass
        assert "laval-rig" in await asyncio.to_thread(get, told["address"])
        assert told["operator"].startswith(f"{told['address']}operator?key=")
        await demo.stdout.read()
        await demo.wait()
    assert demo.returncode == 0
    with pytest.raises(OSError, match="refused"):
        await asyncio.to_thread(get, told["address"])


@pytest.mark.long
async def test_what_is_played_again_loses_nothing_and_ends_when_it_is_enough() -> None:
    parser = argparse.ArgumentParser()
    DemoCommand().add_arguments(parser)
    script = script_of(parser.parse_args([]))
    heard: list[Received] = []
    session = DemoSession(script, speed=1e6, broker_url=None, on_message=heard.append, again=True)
    playing = asyncio.create_task(session.run())
    await eventually(lambda: session.outcome.samples_sent > 0, "it was played once")
    await eventually(
        lambda: session.node is not None and session.node.frames_sent > 500, "it is played again"
    )
    declared = len(session.outcome.diagnoses)
    assert session.enough()
    assert not session.enough(), "a second Ctrl-C breaks it off"
    outcome = await playing
    assert outcome.complete
    assert outcome.samples_sent > len(script.samples)
    assert not [one for one in heard if one.payload.get("quality") == "not_ok"], "the shaft turns on"
    counted = outcome.figures["streams"]["shaft"]
    assert (counted["samples_received"], counted["samples_lost"]) == (outcome.samples_sent, 0)
    assert len(outcome.diagnoses) == declared, "only what was played first is held against its onsets"
