"""The whole chain as separate processes: simulated device, vcan, service, broker."""

from __future__ import annotations

import asyncio
import contextlib
import json
import signal
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from brokers import Consumer, running_mosquitto

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from vcan_links import VcanLink

MOTOR = Path(__file__).parents[2] / "config" / "machines" / "motor-accelerometer.toml"
RATE_HZ = 12_000
PLAYED_S = 6.0
PATIENCE_S = 60.0


@contextlib.asynccontextmanager
async def service(machine: Path, store: Path) -> AsyncIterator[asyncio.subprocess.Process]:
    """``daqsvc run``, stopped at the end as systemd stops it."""
    process = await asyncio.create_subprocess_exec(
        sys.executable, "-m", "daqsvc", "run", str(machine), "--store", str(store)
    )
    try:
        yield process
        process.send_signal(signal.SIGTERM)
        async with asyncio.timeout(20):
            assert await process.wait() == 0
    finally:
        with contextlib.suppress(ProcessLookupError):
            process.kill()
        await process.wait()


async def simulate(machine: Path, recording: Path) -> dict[str, Any]:
    """``daqsvc sim``; returns what it says that it sent."""
    process = await asyncio.create_subprocess_exec(
        *(sys.executable, "-m", "daqsvc", "sim", str(machine), "--recording", str(recording)),
        *("--map", "accel-de=de", "--fs", str(RATE_HZ)),
        stdout=asyncio.subprocess.PIPE,
    )
    output, _ = await process.communicate()
    assert process.returncode == 0
    summary: dict[str, Any] = json.loads(output)
    return summary


async def status_until(consumer: Consumer, true: Any, what: str) -> dict[str, Any]:
    """The first status message of which something is true."""
    try:
        async with asyncio.timeout(PATIENCE_S):
            while True:
                for message in reversed(consumer.on("/status")):
                    figures = message.payload.get("figures")
                    if figures is not None and true(figures):
                        return figures  # type: ignore[no-any-return]
                await asyncio.sleep(0.1)
    except TimeoutError:
        seen = consumer.on("/status")
        pytest.fail(f"not within {PATIENCE_S:g} s: {what}; last status {seen[-1].payload if seen else None}")


@pytest.mark.timeout(200)
async def test_what_the_device_sends_is_what_the_service_has(vcan: VcanLink, tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    recording = tmp_path / "motor.npz"
    # Far above the alarm's setpoint, so that the chain is used to its end.
    np.savez(recording, de=rng.normal(0.0, 1.0, int(PLAYED_S * RATE_HZ)))
    with running_mosquitto(tmp_path) as broker:
        text = (
            MOTOR.read_text()
            .replace('"can0"', f'"{vcan.name}"')
            .replace(f'bus = "{vcan.name}"', 'bus = "can0"')
        )
        machine = tmp_path / "motor.toml"
        machine.write_text(text.replace("127.0.0.1:1883", f"127.0.0.1:{broker.port}"))
        async with Consumer(broker.port) as consumer, service(machine, tmp_path / "store"):
            await status_until(consumer, lambda f: f["buses"]["can0"]["up"] == 1, "the bus is up")
            summary = await simulate(machine, recording)
            sent = summary["streams"]["drive-end"]["samples_sent"]
            assert summary["complete"]
            assert sent == PLAYED_S * RATE_HZ

            def all_there(figures: dict[str, Any]) -> bool:
                stream = figures["streams"]["drive-end"]
                return bool(stream["samples_received"] + stream["samples_lost"] >= sent)

            figures = await status_until(consumer, all_there, f"{sent} samples stored or counted as lost")
            stream, bus = figures["streams"]["drive-end"], figures["buses"]["can0"]
            assert stream["samples_received"] + stream["samples_lost"] == sent
            assert stream["samples_lost"] == 30 * bus["frames_overrun"]
            assert (stream["frames_corrupt"], stream["frames_rejected"], bus["frames_unknown"]) == (0, 0, 0)
            alarms = [m.payload["level"] for m in consumer.on("/alarm")]
            assert "danger" in alarms
