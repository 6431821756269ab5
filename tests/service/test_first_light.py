"""From bytes on a bus to an alarm at a broker: the whole service, seen from outside."""

from __future__ import annotations

import asyncio
import json
import subprocess
import sys
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from support.brokers import Consumer, running_mosquitto
from support.examples import first_of
from support.live_service import watch_of

from daqsvc.publish.payloads import AlarmPayload, AvailabilityPayload, DiagnosisPayload, StatusPayload
from daqsvc.recording.recording import Recording, load_recording
from drivers.can.plugin import frame_layout
from sim_hw.demo.broker import EmbeddedBroker
from sim_hw.demo.machines import for_recording, laval_rig, setpoints
from sim_hw.demo.session import DemoOutcome, DemoSession, Script, summarise
from sim_hw.link_faults import LinkFaults
from sim_hw.nodes.can_node import quantised
from sim_hw.scenario import load_scenario

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from sim_hw.demo.machines import AlarmLimits
    from sim_hw.demo.session import Received

pytestmark = pytest.mark.integration
MODES = ["N", "F1", "F1L2", "F1L3"]
SCHEMAS = {
    "daqsvc.alarm/1": AlarmPayload,
    "daqsvc.diagnosis/1": DiagnosisPayload,
    "daqsvc.status/1": StatusPayload,
    "daqsvc.availability/1": AvailabilityPayload,
}


def paper(seed: int) -> Script:
    scenario = load_scenario("paper")
    machine = scenario.simulate(seed)
    return Script(
        title="paper",
        machine=lambda url: laval_rig(scenario, machine.noise_um, url),
        stream="shaft",
        samples=np.column_stack([machine.channels[name] for name in ("x_um", "y_um", "keyphasor_v")]),
        rate_hz=machine.rate_hz,
        onsets=machine.onsets,
        samples_per_rev=machine.samples_per_rev,
        seed=seed,
    )


def recorded(
    recording: Recording, limits: AlarmLimits | None = None, faults: LinkFaults | None = None
) -> Script:
    return Script(
        title="recording",
        machine=lambda url: for_recording(recording, "g", limits or {}, url),
        stream="recording",
        samples=recording.samples,
        rate_hz=recording.rate_hz,
        faults=faults,
    )


async def play(
    script: Script,
    speed: float,
    *,
    broker_url: str | None = None,
    hear: Callable[[Received], None] = lambda _: None,
) -> tuple[DemoSession, DemoOutcome]:
    session = DemoSession(script, speed=speed, broker_url=broker_url, on_message=hear)
    return session, await session.run()


@pytest.mark.parametrize(
    "kind",
    [pytest.param("amqtt", marks=pytest.mark.long), pytest.param("mosquitto", marks=pytest.mark.mosquitto)],
)
async def test_the_papers_faults_reach_an_independent_client_in_order(kind: str, tmp_path: Path) -> None:
    async def see(url: str, port: int) -> Consumer:
        async with Consumer(port, "daqsvc/#") as consumer:
            _, outcome = await play(paper(seed=3), speed=1000, broker_url=url)
            assert outcome.complete
        # Somebody who comes later finds the state of every alarm, and that the box has gone.
        async with Consumer(port, "daqsvc/#") as late:
            await asyncio.sleep(0.5)
        kept = {message.topic: message for message in late.messages}
        assert all(message.retained for message in late.messages)
        assert kept["daqsvc/demo/virtual/availability"].payload["state"] == "offline"
        last = [m for m in consumer.messages if m.topic.endswith("/alarms/rotor-fault")][-1]
        assert kept[last.topic].payload == last.payload
        assert kept[last.topic].payload["cause"]["decision"] == "F1L3"
        assert kept[last.topic].payload["level"] == "danger"
        assert not [topic for topic in kept if "/diagnosis/" in topic or topic.endswith("/status")]
        return consumer

    if kind == "amqtt":
        async with EmbeddedBroker() as broker:
            consumer = await see(broker.url, broker.port)
    else:
        with running_mosquitto(tmp_path) as mosquitto:
            consumer = await see(f"mqtt://127.0.0.1:{mosquitto.port}", mosquitto.port)

    for message in consumer.messages:
        SCHEMAS[message.payload["schema"]].model_validate(message.payload)
    said = [m.payload for m in consumer.on("/diagnosis/rotor-bank")]
    declared = [payload["decision"] for payload in said if payload["changed"]]
    assert declared == MODES
    for payload in said:
        assert sum(payload["probabilities"].values()) == pytest.approx(1.0, abs=1e-6)
    alarms = [m.payload for m in consumer.on("/alarms/")]
    sequences = [payload["sequence"] for payload in alarms]
    assert sequences == sorted(set(sequences))
    assert len({payload["id"] for payload in alarms}) == len(alarms)
    rotor = [payload for payload in alarms if payload["alarm"] == "rotor-fault"]
    assert [p["cause"]["decision"] for p in rotor] == MODES[1:]
    assert len({p["occurrence"] for p in rotor}) == 1, "one alarm that is refined, not three"
    states = [m.payload["state"] for m in consumer.on("/availability")]
    assert (states[0], states[-1]) == ("online", "offline")


@pytest.mark.long
async def test_playing_fast_loses_nothing_and_sees_the_same() -> None:
    slow, fast = [(await play(paper(seed=5), speed))[1] for speed in (20, 1000)]
    for outcome in (slow, fast):
        summary = summarise(paper(5), outcome, speed=1)
        assert summary["samples"]["sent"] == summary["samples"]["received"] > 10_000
        assert summary["samples"]["lost"] == summary["samples"]["skipped_by_detectors"] == 0
        assert summary["declared"] == MODES
        assert summary["loop_lag_ms"]["p99"] > 0
    # Detectors run side by side, so only each one's own statements have an order.
    at = [
        sorted((d["detector"], d["window"]["end_index"], d["decision"]) for d in o.diagnoses)
        for o in (slow, fast)
    ]
    assert at[0] == at[1]


@pytest.mark.long
@pytest.mark.data
async def test_a_race_fault_arrives_sample_for_sample_and_raises_the_alarm_of_record_97(data: Path) -> None:
    """CWRU records 97 (healthy) and 105 (inner race), https://engineering.case.edu/bearingdatacenter."""
    healthy = load_recording(data / "cwru" / "97.mat", {"accel-de": "X097_DE_time"}, 48_000.0)
    fault = load_recording(data / "cwru" / "105.mat", {"accel-de": "X105_DE_time"}, 12_000.0)
    limits = setpoints(healthy, fault.rate_hz)
    script = recorded(fault, limits)
    heard: list[Received] = []
    session, outcome = await play(script, speed=1, hear=heard.append)

    assert session.service is not None
    ring = watch_of(session.service).rings["recording"]
    got = ring.read(ring.oldest_index, ring.end_index - ring.oldest_index)
    layout = frame_layout(watch_of(session.service).machine, "recording")
    whole = len(fault.samples) // layout.samples_per_frame * layout.samples_per_frame
    sent = quantised(fault.samples[:whole], layout)
    assert ring.end_index == whole
    assert len(got) == min(whole, ring.capacity)
    np.testing.assert_array_equal(got.view(np.uint32), sent[-len(got) :].view(np.uint32))
    assert np.abs(sent[:, 0] - fault.samples[:whole, 0]).max() <= layout.scale[0, 0] / 2 + 1e-9
    stream = outcome.figures["streams"]["recording"]
    assert (stream["samples_received"], stream["samples_lost"]) == (whole, 0)

    raised = [m.payload for m in heard if m.kind == "alarm" and m.payload["kind"] == "raised"]
    assert [payload["alarm"] for payload in raised] == ["vibration-accel-de"]
    assert raised[0]["cause"]["statistics"]["rms"] > limits["accel-de"][0]
    # And the healthy machine, at the same rate, does not raise it.
    from scipy.signal import resample_poly

    quiet = Recording(
        ("accel-de",), resample_poly(healthy.samples[:, 0], 1, 4)[:, None], 12_000.0, healthy.source, 0
    )
    _, calm = await play(recorded(quiet, limits), speed=1000)
    assert calm.alarms == 0


@pytest.mark.long
@pytest.mark.parametrize("seed", range(5))
async def test_loss_counters_equal_what_was_injected(seed: int) -> None:
    rng = np.random.default_rng(seed)
    noise = Recording(("a",), rng.normal(size=(120_000, 1)), 12_000.0, __file__, 0)  # type: ignore[arg-type]
    faults = LinkFaults(drop=0.01, duplicate=0.01, reorder=0.01, corrupt=0.01, seed=seed)
    script = recorded(noise, faults=faults)
    session, outcome = await play(script, speed=1000)
    summary = summarise(script, outcome, speed=1000)
    injected = summary["frames"]["injected"]
    assert min(injected.values()) >= 15  # of 4000 frames, 1 % each
    assert summary["frames"]["counted"] == injected
    assert (summary["frames"]["late"], summary["frames"]["rejected"]) == (0, 0)
    lost = 30 * (injected["dropped"] + injected["corrupted"])
    assert summary["samples"]["lost"] == lost
    assert summary["samples"]["received"] == summary["samples"]["sent"] - lost
    # What did arrive lies where it belongs, and only what is missing is NaN.
    assert session.service is not None
    ring = watch_of(session.service).rings["recording"]
    got = ring.read(ring.oldest_index, ring.end_index - ring.oldest_index)[:, 0]
    layout = frame_layout(watch_of(session.service).machine, "recording")
    sent = quantised(noise.samples[: ring.end_index], layout)[-len(got) :, 0]
    there = np.isfinite(got)
    np.testing.assert_array_equal(got[there], sent[there])
    assert (~there).sum() <= lost
    assert outcome.complete


def demo(*arguments: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "daqsvc", "demo", *arguments]
    return subprocess.run(command, capture_output=True, text=True, timeout=100, check=False)


@pytest.mark.long
def test_the_demo_prints_one_json_object_a_line() -> None:
    done = demo("--scenario", "paper", "--json", "--seed", "7", "--speed", "200")
    assert (done.returncode, done.stderr.count("Traceback")) == (0, 0)
    lines: list[dict[str, Any]] = [json.loads(line) for line in done.stdout.splitlines()]
    assert {line["type"] for line in lines} == {"diagnosis", "alarm", "status", "summary"}
    assert [line["type"] for line in lines].index("summary") == len(lines) - 1
    summary = lines[-1]
    assert summary["declared"] == MODES
    assert [row["mode"] for row in summary["onsets"]] == MODES
    assert all(0 < row["delay_rev"] < 6 for row in summary["onsets"])
    figures = [line["figures"] for line in lines if line["type"] == "status"][-1]
    assert figures["loop_lag_ms"]["p99"] > 0
    assert figures["streams"]["shaft"]["samples_lost"] == 0


@pytest.mark.long
def test_the_demo_in_a_pipe_tells_alarms_and_a_summary() -> None:
    done = demo("--speed", "200", "--seed", "2")
    assert done.returncode == 0
    for word in (
        "F1L3",
        "delay (rev)",
        "wrong declarations: 0",
        "10,314 sent, 10,314 received, 0 lost",
        "p99",
    ):
        assert word in done.stdout


@pytest.mark.parametrize(
    ("arguments", "words"),
    first_of(
        (["--broker", "mqtt://127.0.0.1:1"], "the broker mqtt://127.0.0.1:1 does not answer"),
        (["--scenario", "nonesuch"], "nonesuch"),
        (["--recording", "nowhere.mat", "--fs", "12000"], "nowhere.mat"),
    ),
)
def test_what_cannot_be_played_is_said_in_one_line(arguments: list[str], words: str) -> None:
    done = demo(*arguments)
    assert done.returncode == 1
    assert words in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1
