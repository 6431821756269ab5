"""Metrics and health over HTTP: what they say, that Prometheus takes them, and that they end nothing else."""

from __future__ import annotations

import asyncio
import contextlib
import http.client
import json
import logging
import re
import socket
import subprocess
import time
import urllib.parse
import urllib.request
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import pytest
from prometheus_client.parser import text_string_to_metric_families
from support.live_service import running
from support.machine_files import LAVAL, only_problem, parsed
from support.mqtt_publishing import output_port
from support.paths import ROOT
from support.ports import LOOPBACK, free_port
from support.prometheus_programs import program
from support.waiting import PATIENCE_S, eventually

from daqsvc.acquisition.clock import SystemClock
from daqsvc.box import Box
from daqsvc.commands.status_text import status_text
from daqsvc.control import ask_status
from daqsvc.diagnosis.reading import Reading
from daqsvc.diagnosis.record import Diagnosis
from daqsvc.outbox.store import Outbox
from daqsvc.publish.faults import fault_counts
from daqsvc.publish.metrics import output as output_module
from daqsvc.publish.metrics import server as server_module
from daqsvc.publish.metrics.output import MetricsOutput
from daqsvc.publish.metrics.settings import Metrics
from daqsvc.publish.output import Watched
from daqsvc.service import Service
from daqsvc.settings.addresses import address_of
from daqsvc.supervision import Progress, StallWatch

if TYPE_CHECKING:
    from collections.abc import AsyncIterator
    from pathlib import Path

    from daqsvc.settings import MachineFile

pytestmark = pytest.mark.integration
FREE = "end what listens there, or write another listen in [metrics]"
RULES = ROOT / "config" / "prometheus" / "daqsvc.rules.yml"
RIG = Watched(
    "laval-rig",
    readings=(
        Reading("levels/probe-x", "statistics", "rms", "um"),
        Reading("rotor-bank", "probabilities", "F1"),
    ),
    findings=("rotor-bank",),
)


def rig(port: int) -> MachineFile:
    virtual = ('interface = "socketcan"', 'interface = "virtual"')
    return parsed(LAVAL, virtual, ("[mqtt]", f'[metrics]\nlisten = "{LOOPBACK}:{port}"\n\n[mqtt]'))


def get(port: int, path: str = "/metrics") -> tuple[int, str]:
    connection = http.client.HTTPConnection(LOOPBACK, port, timeout=PATIENCE_S)
    try:
        connection.request("GET", path)
        answer = connection.getresponse()
        return answer.status, answer.read().decode()
    finally:
        connection.close()


def samples(text: str) -> dict[tuple[str, tuple[tuple[str, str], ...]], float]:
    """Values by name and labels, but for the machine."""
    found: dict[Any, float] = {}
    for family in text_string_to_metric_families(text):
        for sample in family.samples:
            labels = tuple(sorted(pair for pair in sample.labels.items() if pair[0] != "machine"))
            assert (sample.name, labels) not in found, "each series once"
            found[sample.name, labels] = sample.value
    return found


@contextlib.asynccontextmanager
async def serving(tmp_path: Path, port: int, **more: Any) -> AsyncIterator[MetricsOutput]:
    """The output of the rig, which runs."""
    outbox = Outbox(tmp_path / "outbox.sqlite", SystemClock())
    await outbox.open()
    given = output_port(outbox, replace(RIG, rates_hz={"shaft": 640.0}), clock=SystemClock())
    for name, value in more.items():
        object.__setattr__(given, name, value)
    output = MetricsOutput(Metrics(listen=f"{LOOPBACK}:{port}"), given)
    work = asyncio.create_task(output.run())
    try:
        yield output
    finally:
        work.cancel()
        await asyncio.wait({work})
        await outbox.close()
    with pytest.raises(OSError, match="refused"):
        socket.create_connection((LOOPBACK, port), 1.0)


def figures(tmp_path: Path) -> dict[str, Any]:
    """Those of a rig on which something of everything has happened."""
    told = Service(Box.single(rig(free_port())), tmp_path / "other").figures()
    told["streams"]["shaft"] |= {"samples_lost": 7, "frames_corrupt": 3, "rate_hz": 639.5, "time_settled": 1}
    told["buses"]["can0"] |= {"up": 1, "bus_off": 2, "unknown_ids": {"0x7ff": 9}}
    told["detectors"]["rotor-bank"] |= {"busy_ns": 1_500_000_000}
    told["outbox"] |= {"depth": 4, "unbacked": 1}
    told["outbox"]["telemetry"]["dropped_full"] = 5
    told["failures"] = {"driver can0": 2, "thread 4711": 1}
    told["mqtt"] |= {"certificates": {"broker": {"not_after_seconds": 1_800_000_000, "days_left": 3.0}}}
    return told


async def served(tmp_path: Path) -> str:
    port = free_port()
    async with serving(tmp_path, port) as output:
        output.status(figures(tmp_path))
        for statement in (
            {"detector": "levels/probe-x", "statistics": {"rms": 7.5, "peak": 9.0}},
            {"detector": "rotor-bank", "probabilities": {"F1": 0.25}, "quality": "missing"},
            {"detector": "of nobody's"},
        ):
            fields: dict[str, Any] = {
                "machine": "laval-rig",
                "stream": "shaft",
                "decision": "normal",
                **statement,
            }
            output.report(Diagnosis(t_ns=0, first_index=0, end_index=1, **fields))
        await eventually(lambda: output._link.state == "up", "it is served")
        status, text = await asyncio.to_thread(get, port)
        assert status == 200
        return text


async def test_what_the_service_counts_is_what_prometheus_gets(tmp_path: Path) -> None:
    found = samples(await served(tmp_path))
    assert found["daqsvc_stream_samples_lost_total", (("stream", "shaft"),)] == 7
    assert found["daqsvc_stream_rate_hertz", (("stream", "shaft"),)] == 639.5
    assert found["daqsvc_stream_configured_rate_hertz", (("stream", "shaft"),)] == 640.0
    assert found["daqsvc_bus_up", (("bus", "can0"),)] == 1
    assert found["daqsvc_detector_busy_seconds_total", (("detector", "rotor-bank"),)] == 1.5
    assert found["daqsvc_outbox_events", ()] == 4
    assert found["daqsvc_outbox_writable", ()] == 0
    assert found["daqsvc_part_failures_total", ()] == 3
    assert found["daqsvc_broker_connected", ()] == 0
    assert found["daqsvc_certificate_expiry_timestamp_seconds", (("certificate", "broker"),)] == 1.8e9
    assert found["daqsvc_telemetry_faults_total", (("cause", "dropped_full"),)] == 5
    assert found["daqsvc_healthy", ()] == 1
    faults = {key: value for key, value in found.items() if key[0].endswith("_faults_total")}
    counts = list(fault_counts(figures(tmp_path)))
    assert len(faults) == len(counts) > 30, "each count, and none of what a bus may name as it likes"
    assert sum(faults.values()) == sum(fault.times for fault in counts) == 7 + 3 + 2 + 5

    (rms,) = [(key, value) for key, value in found.items() if ("reading", "rms") in key[1]]
    labels = (("detector", "levels/probe-x"), ("kind", "statistics"), ("reading", "rms"), ("unit", "um"))
    assert rms == (("daqsvc_reading", labels), 7.5)
    good = {dict(key[1])["detector"]: v for key, v in found.items() if key[0] == "daqsvc_detector_good"}
    assert good == {"levels/probe-x": 1, "rotor-bank": 0}, "of no others: labels do not grow"
    spoke_s = found["daqsvc_detector_last_statement_timestamp_seconds", (("detector", "rotor-bank"),)]
    assert abs(time.time() - spoke_s) < PATIENCE_S


def test_refusals_of_a_modbus_unit_are_faults_of_its_bus(tmp_path: Path) -> None:
    seen = figures(tmp_path)
    refused = {
        "exceptions": {"illegal function": 13, "gateway": 2},
        "unknown_ids": {"0x7": 4},
        "odd": {"a": "b"},
    }
    seen = {**seen, "buses": {"modbus": {"up": 1, **refused}}}
    found = {fault.cause: fault.times for fault in fault_counts(seen) if fault.kind == "buses"}
    assert found == {"exceptions": 15}


async def test_who_asks_for_some_metrics_gets_these(tmp_path: Path) -> None:
    port = free_port()
    async with serving(tmp_path, port) as output:
        output.status(figures(tmp_path))
        await eventually(lambda: output._link.state == "up", "it is served")
        asked = "/metrics?name[]=daqsvc_bus_up&name[]=daqsvc_part_failures_total&name[]=process_open_fds"
        found = samples((await asyncio.to_thread(get, port, asked))[1])
    assert {name for name, _ in found} == {
        "daqsvc_bus_up",
        "daqsvc_part_failures_total",
        "process_open_fds",
    }


async def test_promtool_has_nothing_against_the_metrics(tmp_path: Path) -> None:
    text = await served(tmp_path)
    command = [program("promtool"), "check", "metrics"]
    checked = subprocess.run(command, input=text, capture_output=True, text=True, timeout=60, check=False)  # noqa: ASYNC221
    assert (checked.returncode, checked.stdout, checked.stderr) == (0, "", "")


async def test_the_rules_are_sound_and_about_metrics_that_there_are(tmp_path: Path) -> None:
    text = RULES.read_text()
    named = set(re.findall(r"\bdaqsvc_[a-z0-9_]+", text))
    there = {name for name, _ in samples(await served(tmp_path))}
    assert named <= there
    assert len(named) > 10
    command = [program("promtool"), "check", "rules", str(RULES)]
    checked = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)  # noqa: ASYNC221
    assert checked.returncode == 0, checked.stderr


async def test_the_documented_metrics_are_those_that_there_are(tmp_path: Path) -> None:
    table = (ROOT / "docs" / "status.md").read_text()
    documented = set(re.findall(r"^\| `(daqsvc_[a-z0-9_]+)`", table, re.MULTILINE))
    there = {name for name, _ in samples(await served(tmp_path)) if name.startswith("daqsvc_")}
    assert documented == there


async def test_a_part_that_does_not_get_on_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(output_module, "STALLED_S", 0.0)
    monkeypatch.setattr(output_module, "LOOK_S", 0.02)
    port, steps = free_port(), {"outbox": Progress(None), "detector levels": Progress(None)}
    async with serving(tmp_path, port, stalls=StallWatch(lambda: dict(steps))) as output:
        monkeypatch.setattr(output_module, "STALLED_S", 30.0)
        await eventually(lambda: output._link.state == "up", "it is served")
        assert await asyncio.to_thread(get, port, "/healthz") == (200, "ok\n")
        steps["detector levels"] = Progress(7)
        await eventually(output.unhealthy, "that is seen")
        status, words = await asyncio.to_thread(get, port, "/healthz")
        assert (status, words) == (503, "detector levels has taken no step for 30 s or more\n")
        assert samples((await asyncio.to_thread(get, port))[1])["daqsvc_healthy", ()] == 0
        steps["detector levels"] = Progress(None)
        await eventually(lambda: not output.unhealthy(), "it gets on again")
        assert (await asyncio.to_thread(get, port, "/healthz"))[0] == 200


async def test_an_event_loop_that_stands_still_is_said_all_the_same(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    port = free_port()
    async with serving(tmp_path, port) as output:
        await eventually(lambda: output._link.state == "up", "it is served")
        monkeypatch.setattr(output_module, "STALLED_S", 0.3)
        time.sleep(0.4)  # noqa: ASYNC251 - that is what is tested
        status, words = get(port, "/healthz")
        assert status == 503
        assert words.startswith("the event loop has been blocked for ")


async def test_a_port_in_use_is_said_once_and_taken_when_it_is_free(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with socket.socket() as other:
        other.bind((LOOPBACK, 0))
        other.listen()
        port = other.getsockname()[1]
        # Only the metrics of the service miss: it runs, and takes questions and commands.
        async with running(rig(port), tmp_path / "store") as service:
            output = service.alarms.outputs["metrics"]
            assert isinstance(output, MetricsOutput)
            await eventually(lambda: output.reason, "it is found")
            [status] = await asyncio.to_thread(ask_status, tmp_path / "store")
            reason = f"Address already in use: {FREE}"
            assert status["outputs"]["metrics"].pop("away_s") >= 0.0
            assert status["outputs"]["metrics"] == {"connected": None, "reason": reason, "code": "B29"}
            assert f"metrics: {reason}" in status_text(status, 200)
            assert service.control._server is not None
            other.close()
            await eventually(lambda: output._link.state == "up", "it is served")
            assert (await asyncio.to_thread(get, port, "/healthz"))[0] == 200
            assert output.reason == ""
            assert service.supervisor.failures.total() == 0
    said = [r.getMessage() for r in caplog.records if "metrics at" in r.message and r.levelno > logging.INFO]
    remedy = f"{FREE}; it is being tried again"
    name = f"metrics at {LOOPBACK}:{port}"
    assert said == [f"{name}: Address already in use: {remedy}", f"{name} is there now"]


async def test_clients_that_hang_keep_nobody_out_for_long(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(server_module, "PATIENCE_S", 0.3)
    port = free_port()
    async with serving(tmp_path, port) as output:
        await eventually(lambda: output._link.state == "up", "it is served")
        with contextlib.ExitStack() as idle:
            for _ in range(server_module.MOST_CLIENTS + 1):
                idle.enter_context(socket.create_connection((LOOPBACK, port), PATIENCE_S)).sendall(b"GET /he")

            def answered() -> bool:
                with contextlib.suppress(OSError, http.client.HTTPException):
                    return get(port, "/healthz")[0] == 200
                return False

            until_s = time.monotonic() + PATIENCE_S
            while not await asyncio.to_thread(answered):
                assert time.monotonic() < until_s


async def test_other_paths_and_methods_are_refused(tmp_path: Path) -> None:
    port = free_port()
    async with serving(tmp_path, port) as output:
        await eventually(lambda: output._link.state == "up", "it is served")
        assert (await asyncio.to_thread(get, port, "/"))[0] == 404
        for path, kind in (("/healthz", b"text/plain"), ("/metrics", b"text/plain"), ("/", b"text/html")):
            reader, writer = await asyncio.open_connection(LOOPBACK, port)
            writer.write(b"HEAD %s HTTP/1.0\r\n\r\n" % path.encode())
            head, _, body = (await reader.read()).partition(b"\r\n\r\n")
            assert (b" 404 " if path == "/" else b" 200 ") in head
            assert (kind in head, body) == (True, b"")
            writer.close()
        reader, writer = await asyncio.open_connection(LOOPBACK, port)
        writer.write(b"POST /metrics HTTP/1.0\r\n\r\n")
        assert b" 501 " in await reader.readline()
        writer.close()


@pytest.mark.parametrize(
    "text", ["", "9464", "127.0.0.1", "127.0.0.1:0", "host:99999", "::1:9464", "[h]:1", "h:٣"]
)
def test_what_is_no_address_is_refused(text: str) -> None:
    assert address_of(text) is None
    problem, _ = only_problem(LAVAL, ("[mqtt]", f'[metrics]\nlisten = "{text}"\n[mqtt]'))
    assert problem.key == "metrics.listen"


@pytest.mark.parametrize(
    ("listen", "warns"),
    [("localhost:1", 0), ("127.0.0.1:1", 0), ("[::1]:1", 0), ("0.0.0.0:1", 1), ("[::]:1", 1), ("box:1", 1)],
)
def test_only_the_box_itself_may_read_them_without_a_warning(listen: str, warns: int) -> None:
    machine = parsed(LAVAL, ("[mqtt]", f'[metrics]\nlisten = "{listen}"\n[mqtt]'))
    said = [one for one in machine.warnings if "metrics" in str(one)]
    assert len(said) == warns
    assert all("lets everybody in that network read the metrics" in str(one) for one in said)


@pytest.mark.long
async def test_prometheus_itself_scrapes_a_service(tmp_path: Path) -> None:
    port, own = free_port(), free_port()
    config = tmp_path / "prometheus.yml"
    config.write_text(
        f"global: {{scrape_interval: 1s, evaluation_interval: 1s}}\nrule_files: ['{RULES}']\n"
        f"scrape_configs: [{{job_name: daqsvc, static_configs: [{{targets: ['{LOOPBACK}:{port}']}}]}}]\n"
    )
    command = [program("prometheus"), f"--config.file={config}", f"--storage.tsdb.path={tmp_path / 'tsdb'}"]
    command += [f"--web.listen-address={LOOPBACK}:{own}"]

    def query(expression: str) -> list[Any]:
        address = f"http://{LOOPBACK}:{own}/api/v1/query?query={urllib.parse.quote(expression)}"
        with contextlib.suppress(OSError), urllib.request.urlopen(address, timeout=5.0) as answer:
            result: list[Any] = json.load(answer)["data"]["result"]
            return result
        return []

    async def until(expression: str) -> list[Any]:
        until_s = time.monotonic() + 2 * PATIENCE_S
        while not (found := await asyncio.to_thread(query, expression)):
            assert time.monotonic() < until_s, f"{expression} never holds"
            await asyncio.sleep(0.2)
        return found

    with (
        (tmp_path / "log").open("wb") as log,
        subprocess.Popen(command, stderr=log, stdout=log) as prometheus,  # noqa: ASYNC220 - as above
    ):
        try:
            async with running(rig(port), tmp_path / "store"):
                await until('up{job="daqsvc"} == 1')
                (bus,) = await until('daqsvc_bus_up{machine="laval-rig"}')
                assert bus["metric"]["bus"] == "can0"
                await until("daqsvc_healthy == 1")
                (pending,) = await until('ALERTS{alertname="DaqsvcBrokerAway"}')
                assert pending["metric"]["alertstate"] == "pending"
                assert await until("scrape_samples_scraped > 60")
            await until('up{job="daqsvc"} == 0')
        finally:
            prometheus.terminate()
