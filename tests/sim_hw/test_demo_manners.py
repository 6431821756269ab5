"""How the demo takes wrong arguments, bad recordings, closed pipes, lost brokers and signals."""

from __future__ import annotations

import argparse
import asyncio
import io
import json
import os
import signal
import subprocess
import sys
import time
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from rich.console import Console
from support.examples import first_of
from support.given_codes import had

from daqsvc import service as service_module
from daqsvc.outbox.journal import Journal
from daqsvc.service import Service
from sim_hw.demo import broker, session
from sim_hw.demo.broker import EmbeddedBroker
from sim_hw.demo.command import DemoCommand, script_of
from sim_hw.demo.machines import DemoError
from sim_hw.demo.session import DemoSession, Script
from sim_hw.demo.view import View, _PipeConsole

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable
    from pathlib import Path

    from daqsvc.supervision import Part
    from sim_hw.demo.session import Received

pytestmark = pytest.mark.integration
RATE_HZ = 2000.0


def arguments_of(*arguments: str) -> argparse.Namespace:
    parser = argparse.ArgumentParser()
    DemoCommand().add_arguments(parser)
    return parser.parse_args(arguments)


def save(path: Path, **arrays: Any) -> Path:
    np.savez(path, **{"fs": RATE_HZ, **arrays})
    return path


def noise(duration_s: float) -> np.ndarray:
    return np.random.default_rng(4).normal(size=round(duration_s * RATE_HZ))


def recorded(tmp_path: Path, duration_s: float = 60.0) -> Script:
    return script_of(arguments_of("--recording", str(save(tmp_path / "rig.npz", a=noise(duration_s)))))


def demo(*arguments: str, **options: Any) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "daqsvc", "demo", *arguments]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    return subprocess.Popen(command, text=True, **{**pipes, **options})


async def test_it_removes_the_store_when_the_disk_has_taken_everything(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    close, closed = Journal.close, []

    def late(journal: Journal) -> None:
        time.sleep(2 * service_module.CLOSE_S)  # longer than a service waits that is to stop at once
        close(journal)
        closed.append(journal)

    monkeypatch.setattr(Journal, "close", late)
    stop_all, patience_s = service_module.stop_all, []

    async def stopping(parts: Iterable[Part], seconds: float) -> None:
        patience_s.append(seconds)
        await stop_all(parts, seconds)

    monkeypatch.setattr(service_module, "stop_all", stopping)
    script = recorded(tmp_path, 5.0)
    outcome = await DemoSession(script, speed=1000, broker_url=None, on_message=lambda _: None).run()
    assert outcome.complete
    # A detector may still compute: a thread that is left behind could end the process with a crash.
    assert min(patience_s) > 5.0
    assert closed, "the folder is removed before the journal is closed"
    assert "did not close" not in caplog.text


# What a person types wrong.


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ("--snr-db inf", "'inf' is not a number from -200 to 200 dB"),
        ("--snr-db nan", "'nan' is not a number"),
        ("--snr-db 1e9", "-200 to 200 dB"),
        ("--broker mqtts://box:8883", "the demo does not speak TLS"),
        ("--broker http://box", "not the address of a broker; write mqtt://HOST"),
        ("--broker box:1883", "not the address of a broker"),
        ("--broker mqtt://", "not the address of a broker"),
        ("--broker mqtt://box:99999", "port must be a number from 1 to 65535"),
        ("--broker mqtt://box:0", "port must be a number from 1 to 65535"),
        ("--broker mqtt://box:x", "port must be a number from 1 to 65535"),
        ("--broker mqtt://box/topic", "something after host and port"),
        ("--fs 0.5 --recording a.npz", "not a sampling rate from 1 to 10,000,000 Hz"),
        ("--fs 2e7 --recording a.npz", "not a sampling rate"),
        ("--map x=a,x=b --recording a.npz", "names 'x' twice"),
        ("--map x=a", "--map goes with a recording; give that with --recording"),
        ("--fs 100", "--fs goes with a recording"),
        ("--unit g", "--unit goes with a recording"),
        ("--baseline a.npz", "--baseline goes with a recording"),
        ("--baseline-fs 100", "--baseline-fs goes with a recording"),
        ("--recording a.npz --baseline-map x=a", "--baseline-map goes with a baseline"),
        ("--recording a.npz --baseline-fs 100", "--baseline-fs goes with a baseline"),
        ("--recording a.npz --scenario paper", "--scenario goes with a scenario, and --recording plays"),
        ("--recording a.npz --seed 0", "--seed goes with a scenario"),
        ("--recording a.npz --snr-db 3", "--snr-db goes with a scenario"),
    ],
)
def test_misuse_is_a_usage_error(arguments: str, words: str, capsys: pytest.CaptureFixture[str]) -> None:
    parser = argparse.ArgumentParser()
    command = DemoCommand()
    command.add_arguments(parser)
    with pytest.raises(SystemExit) as ended:
        command.run(parser.parse_args(arguments.split()))
    assert ended.value.code == 2
    assert words in capsys.readouterr().err


def test_a_password_in_the_address_is_not_repeated(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        arguments_of("--broker", "mqtt://daq:hunter2@box")
    errors = capsys.readouterr().err
    assert "does not log in" in errors
    assert "hunter2" not in errors


def test_what_is_right_stays_right() -> None:
    assert arguments_of("--broker", "mqtt://[::1]:1884").broker == "mqtt://[::1]:1884"
    assert script_of(arguments_of()).title == script_of(arguments_of("--scenario", "paper")).title


# Recordings that cannot be played.

BAD = np.array([1.0, np.nan, np.inf, -np.inf] * 1000)


@pytest.mark.parametrize(
    ("arrays", "options", "words"),
    [
        ({"a": BAD, "b": noise(2)}, [], r"holds 1000 NaN and 2000 infinite samples \(in a\)"),
        ({"a": np.where(np.isnan(BAD), 0, BAD)}, [], "holds 2000 infinite samples"),
        ({"a": noise(0.4)}, [], r"is too short: 800 samples at 2000 Hz last 0\.4 s; give at least 0\.5 s"),
        ({"a": noise(2), "fs": 20.0}, [], r"at 20 Hz as a: 0\.5 s at 20 Hz are fewer than 16 samples.*--fs"),
        ({"a b": noise(2), "a-b": noise(2)}, [], "'a b' and 'a-b' would both be sensor 'a-b'; .*--map"),
        ({"§": noise(2)}, [], "no sensor can be named '§'"),
        ({"a" * 65: noise(2)}, [], "longer than the 64 characters"),
    ],
)
def test_recordings_that_cannot_be_played(
    arrays: dict[str, Any], options: list[str], words: str, tmp_path: Path
) -> None:
    path = save(tmp_path / "rig.npz", **arrays)
    with pytest.raises(DemoError, match=words) as refused:
        script_of(arguments_of("--recording", str(path), *options))
    assert "rig.npz" in str(refused.value)
    assert "recorded-machine.toml" not in str(refused.value)


@pytest.mark.parametrize(
    ("baseline", "words"),
    [
        (np.full(4000, 3.25), r"healthy\.npz does not move: every sample of a is 3\.25"),
        (1e-320 * noise(2), r"at 2000 Hz as a: .*give another baseline \(--baseline\)"),
    ],
)
def test_baselines_that_give_no_setpoints(baseline: np.ndarray, words: str, tmp_path: Path) -> None:
    path, healthy = save(tmp_path / "rig.npz", a=noise(2)), save(tmp_path / "healthy.npz", a=baseline)
    with pytest.raises(DemoError, match=words):
        script_of(arguments_of("--recording", str(path), "--baseline", str(healthy)))


def test_channels_that_are_left_out_are_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = save(tmp_path / "rig.npz", a=noise(2), slow=noise(1), b=noise(2))
    script = script_of(arguments_of("--recording", str(path)))
    assert script.samples.shape == (4000, 2)
    (line,) = capsys.readouterr().err.splitlines()
    assert "left out slow (2000 samples): not as long as the others (4000 samples)" in line
    assert "--map" in line
    script_of(arguments_of("--recording", str(path), "--map", "x=a"))
    assert capsys.readouterr().err == ""


# What ends the playing before its time.


async def broken_off(
    script: Script, on_message: Callable[[Received], None], url: str | None = None
) -> DemoSession:
    """The session after its failure, with the service stopped and not much played."""
    playing = DemoSession(script, speed=20, broker_url=url, on_message=on_message)
    with pytest.raises((BrokenPipeError, DemoError)) as failed:
        await playing.run()
    playing.error = failed.value  # type: ignore[attr-defined]
    assert playing.node is not None
    assert playing.node.samples_sent < len(script.samples)
    return playing


async def test_whoever_listens_no_more_ends_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    ended: list[str] = []
    run = Service.run

    async def watched(self: Service, stop: asyncio.Event) -> None:
        await run(self, stop)
        ended.append("in order" if stop.is_set() else "broken off")

    monkeypatch.setattr(Service, "run", watched)

    def on_message(message: Received) -> None:
        if message.kind == "diagnosis":
            raise BrokenPipeError

    playing = await broken_off(recorded(tmp_path), on_message)
    assert isinstance(playing.error, BrokenPipeError)  # type: ignore[attr-defined]
    assert ended == ["in order"]


async def test_a_lost_broker_ends_it_and_is_said(tmp_path: Path) -> None:
    async with EmbeddedBroker() as embedded:
        running = embedded._broker
        assert running is not None

        def on_message(message: Received) -> None:
            if message.kind == "diagnosis":
                for writer in running.writers:
                    writer.transport.abort()

        playing = await broken_off(recorded(tmp_path), on_message, embedded.url)
        assert f"the broker {embedded.url} was lost" in str(playing.error)  # type: ignore[attr-defined]


@pytest.mark.long
async def test_kernels_may_take_their_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(session, "LINK_UP_S", 2.0)
    run = Service.run

    async def slow(self: Service, stop: asyncio.Event) -> None:
        await asyncio.sleep(2.5)
        await run(self, stop)

    monkeypatch.setattr(Service, "run", slow)
    script = recorded(tmp_path, duration_s=1.0)
    # Only the kernels are slow: the links come up within the limit that was lowered for them.
    outcome = await DemoSession(script, speed=1000, broker_url=None, on_message=lambda _: None).run()
    assert outcome.complete


async def test_a_port_that_is_taken_meanwhile_is_replaced(monkeypatch: pytest.MonkeyPatch) -> None:
    async with EmbeddedBroker() as first:
        free_port = broker._free_port
        ports = iter([first.port, first.port])
        monkeypatch.setattr(broker, "_free_port", lambda: next(ports, None) or free_port())
        async with EmbeddedBroker() as second:
            assert second.port != first.port
        with pytest.raises(broker.BrokerError, match="in use"):
            await EmbeddedBroker(first.port).__aenter__()


@pytest.mark.long
def test_a_closed_pipe_ends_it_quietly(tmp_path: Path) -> None:
    path = save(tmp_path / "rig.npz", a=noise(600))
    with demo("--recording", str(path), "--json", "--speed", "2", env=elsewhere(tmp_path)) as running:
        assert running.stdout is not None
        assert running.stderr is not None
        assert json.loads(running.stdout.readline())["type"]
        running.stdout.close()
        # A busy host makes warnings of its own, which have nothing to do with the pipe.
        assert without_delays(running.stderr.read()) == []
        assert running.wait() == 0
    assert left_behind(tmp_path) == []


@pytest.mark.long
@pytest.mark.parametrize("form", [[], ["--json"]])
def test_an_alarm_is_shown_once_where_no_terminal_is(form: list[str], tmp_path: Path) -> None:
    path = save(tmp_path / "rig.npz", a=3.0 * noise(6))
    healthy = save(tmp_path / "healthy.npz", a=noise(6))
    playing = ["--recording", str(path), "--baseline", str(healthy), "--speed", "20", *form]
    with demo(*playing, env=elsewhere(tmp_path), stderr=subprocess.STDOUT) as running:
        said, _ = running.communicate()
    assert running.returncode == 0
    assert said.count("danger limit") == 1, said


@pytest.mark.long
# In the everyday run SIGTERM is that of the job in the background.
@pytest.mark.parametrize("number", first_of(signal.SIGINT, signal.SIGTERM, signal.SIGHUP))
def test_signals_end_it_in_order(number: int, tmp_path: Path) -> None:
    path = save(tmp_path / "rig.npz", a=noise(600))
    with demo("--recording", str(path), "--json", "--speed", "2", env=elsewhere(tmp_path)) as running:
        assert running.stdout is not None
        running.stdout.readline()
        assert left_behind(tmp_path)
        running.send_signal(number)
        _, errors = running.communicate()
        assert without_delays(errors) == ["daqsvc demo: interrupted [C15]"]
        had("C15", without_delays(errors)[0])
        assert running.returncode == 1
    assert left_behind(tmp_path) == []


def without_delays(errors: str) -> list[str]:
    """The lines, but for those that a process writes on a machine too slow for it."""
    slow = ("the process did not run for", "does not close within")
    return [line for line in errors.splitlines() if not any(words in line for words in slow)]


@pytest.mark.long
def test_a_background_job_that_ignores_ctrl_c_ends_in_order_on_sigterm(tmp_path: Path) -> None:
    path = save(tmp_path / "rig.npz", a=noise(600))
    playing = ["--recording", str(path), "--json", "--speed", "2"]
    ignoring = lambda: signal.signal(signal.SIGINT, signal.SIG_IGN)  # noqa: E731
    with demo(*playing, env=elsewhere(tmp_path), preexec_fn=ignoring) as running:
        assert running.stdout is not None
        running.stdout.readline()
        running.send_signal(signal.SIGTERM)
        _, errors = running.communicate()
    assert (without_delays(errors), running.returncode) == (["daqsvc demo: interrupted [C15]"], 1)
    assert left_behind(tmp_path) == []


def test_an_interrupt_during_the_imports_is_no_traceback(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def interrupted(**_options: Any) -> None:
        signal.raise_signal(signal.SIGTERM)

    monkeypatch.setattr("daqsvc.cli.start_logging", interrupted)
    parser = argparse.ArgumentParser()
    command = DemoCommand()
    command.add_arguments(parser)
    before = signal.getsignal(signal.SIGTERM)
    assert command.run(parser.parse_args([])) == 1
    assert capsys.readouterr().err == "daqsvc demo: interrupted [C15]\n"
    assert signal.getsignal(signal.SIGTERM) == before


def elsewhere(tmp_path: Path) -> dict[str, str]:
    (tmp_path / "tmp").mkdir()
    return {**os.environ, "TMPDIR": str(tmp_path / "tmp")}


def left_behind(tmp_path: Path) -> list[Path]:
    return list((tmp_path / "tmp").glob("daqsvc-demo-*"))


# The view.


@pytest.mark.long
async def test_a_low_terminal_shows_loss_lag_and_the_newest_alarm() -> None:
    console = Console(width=60, height=24, file=io.StringIO())
    script = script_of(arguments_of())
    view = View(script, 1000, console)
    await DemoSession(script, speed=1000, broker_url=None, on_message=view.on_message).run()
    lines = console.render_lines(view.picture(), pad=False)
    seen = ["".join(segment.text for segment in line) for line in lines][:22]
    text = "\n".join(seen)
    assert "0 lost" in text
    assert "event loop lag" in text
    assert " now " in text
    newest = view._alarms[0][1]
    assert newest["sequence"] == max(alarm["sequence"] for _, alarm in view._alarms)
    assert f"{newest['level']:<7} {newest['kind']:<9} {newest['alarm']}" in text


def test_a_terminal_is_told_of_the_kernels_before_the_live_view(tmp_path: Path) -> None:
    script = recorded(tmp_path, duration_s=1.0)
    for terminal in (True, False):
        console = Console(force_terminal=terminal, record=True, width=80)
        with console.capture() as captured, View(script, 1.0, console):
            pass
        assert ("the first run compiles kernels" in captured.get()) is terminal


def test_a_closed_pipe_reaches_the_caller_of_the_view() -> None:
    class Closed(io.StringIO):
        def write(self, _text: str) -> int:
            raise BrokenPipeError

    with pytest.raises(BrokenPipeError):
        _PipeConsole(file=Closed()).print("anybody there?")
