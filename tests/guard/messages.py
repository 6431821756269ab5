"""Topics and keys of what a service publishes and prints: names and structure, no values.

Two runs, with processes and a broker as anybody could set them up: ``daqsvc demo --json`` faster than real
time; and ``daqsvc run`` with commands, Home Assistant and Sparkplug, against ``daqsvc sim`` on a virtual bus.
Each run goes on until everything that is waited for has come, so that the union of all messages is the same
every time.
"""

from __future__ import annotations

import contextlib
import json
import re
import signal
import socket
import subprocess
import sys
import threading
import time
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import paho.mqtt.client as paho

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator

PATIENCE_S = 120.0
"""How long to wait for what must come before giving up; nothing is timed by it."""

SEED = "7"
LOOPBACK = "127.0.0.1"
BASE = "daqsvc/lab/virtual/virtual-rig"
_RIG = """
[[alarms]]
name = "shaft-vibration-x"
sensor = "probe-x"
measure = "rms"
alert = 1.0
danger = 1000.0
latching = true

[mqtt.commands]
enabled = true
allow = ["acknowledge", "reset", "shelve", "unshelve", "bypass", "unbypass"]

[mqtt.home_assistant]
every_s = 10.0

[mqtt.sparkplug]
"""


def structure() -> str:
    """Both runs, as a text."""
    return f"{_demo()}\n{_service()}"


def _demo() -> str:
    done = subprocess.run(
        [*_DAQSVC, "demo", "--json", "--speed", "1000", "--seed", SEED],
        capture_output=True,
        check=False,
        text=True,
        timeout=PATIENCE_S,
    )
    if done.returncode:
        raise RuntimeError(f"daqsvc demo ended with {done.returncode}: {done.stderr}")
    found: dict[str, set[str]] = {}
    for line in done.stdout.splitlines():
        said = json.loads(line)
        found.setdefault(f"{said['type']} {said.get('topic', '')}".strip(), set()).update(_keys(said))
    return _listed("daqsvc demo --json", found)


def _service() -> str:
    with _running([sys.executable, "-m", "nothing_lost.amqtt_broker", str(port := _free_port())]):
        heard = _Heard(port)
        try:
            return _with_broker(port, heard)
        finally:
            heard.stop()


def _with_broker(port: int, heard: _Heard) -> str:
    text = Path("machines/virtual-rig.toml").read_text(encoding="utf-8")
    text = text.replace("127.0.0.1:1883", f"{LOOPBACK}:{port}").replace("/tmp/daqsvc-can0", "can0")  # noqa: S108
    machine = Path("machines/messages.toml")
    machine.write_text(text + _RIG, encoding="utf-8")
    told: dict[str, set[str]] = {}
    with (
        _running([*_DAQSVC, "sim", "--bus", "can0"]),
        _running([*_DAQSVC, "run", str(machine), "--store", "store"]) as service,
        _running([*_DAQSVC, "sim", str(machine), "--scenario", "paper", "--seed", SEED, "--duration", "8"]),
    ):
        _until(lambda: f"{BASE}/alarms/shaft-vibration-x" in heard.topics(), "the alarm of a level", heard)
        for verb, more in (
            ("ack", ()),
            ("shelve", ("--for", "10m")),
            ("unshelve", ()),
            ("bypass", ()),
            ("unbypass", ()),
        ):
            line = [*_DAQSVC, verb, "shaft-vibration-x", "--store", "store", *more, "--by", "Ada", "--json"]
            done = subprocess.run(line, capture_output=True, check=True, text=True, timeout=PATIENCE_S)
            told.setdefault("daqsvc VERB --json", set()).update(_keys(json.loads(done.stdout)))
        for schema in ("daqsvc.command/1", "daqsvc.command/2"):
            heard.say(f"{BASE}/commands/acknowledge", _command(schema))
        # The last three of them once the device has fallen silent.
        for wanted in _WANTED:
            _until(lambda wanted=wanted: any(wanted in topic for topic in heard.topics()), wanted, heard)
        line = [*_DAQSVC, "alarms", "--store", "store", "--json", "--all"]
        for options in ((), ("--history",)):
            done = subprocess.run(
                [*line, *options], capture_output=True, check=True, text=True, timeout=PATIENCE_S
            )
            found = told.setdefault(" ".join(["daqsvc alarms --json", *options]), set())
            for one in done.stdout.splitlines():
                found.update(_keys(json.loads(one)))
        service.send_signal(signal.SIGTERM)
        service.wait(PATIENCE_S)
        _until(
            lambda: any("/NDEATH/" in one for one in heard.topics()), "the end of Sparkplug's session", heard
        )
    return f"{_listed('daqsvc run', heard.found())}\n{_listed('the command line', told)}"


_WANTED = (
    "commands/acknowledge/response",
    "/availability",
    "/status",
    "/diagnosis/levels/probe-x",
    "/diagnosis/levels/probe-y",
    "/diagnosis/rotor-bank",
    "/readings/levels/probe-x",
    "/readings/levels/probe-y",
    "/readings/rotor-bank",
    "/summary",
    "/alarms/rotor-fault",
    "homeassistant/",
    "/NBIRTH/",
    "/DBIRTH/",
    "/NDATA/",
    "/DDATA/",
    "/alarms/sensor-ok/probe-x",
    "/alarms/sensor-ok/probe-y",
    "/alarms/detector-ok/rotor-bank",
)
_MODE = re.compile(r"(cusum\.|lead\.|probabilities\.|paper\.)\w+$")
"""Modes of the rotor bank as keys: how many a statement names depends on where it stands."""

_DAQSVC = [sys.executable, "-m", "daqsvc"]


def _command(schema: str) -> str:
    issued_at = datetime.now(UTC).isoformat()
    return json.dumps(
        {
            "schema": schema,
            "id": schema[-1],
            "alarm": "shaft-vibration-x",
            "by": "Ada",
            "issued_at": issued_at,
        }
    )


class _Heard:
    """Everything that goes through a broker."""

    def __init__(self, port: int) -> None:
        self._lock = threading.Lock()
        self._found: dict[str, set[str]] = {}
        self._client = paho.Client(paho.CallbackAPIVersion.VERSION2)
        self._client.on_connect = lambda client, *_: client.subscribe("#", qos=1)
        self._client.on_message = lambda _client, _data, message: self._take(
            message.topic, bytes(message.payload)
        )
        until_s = time.monotonic() + PATIENCE_S
        while True:
            with contextlib.suppress(OSError):
                self._client.connect(LOOPBACK, port)
                break
            if time.monotonic() > until_s:
                raise RuntimeError("the broker does not start")
            time.sleep(0.1)
        self._client.loop_start()

    def stop(self) -> None:
        self._client.disconnect()
        self._client.loop_stop()

    def say(self, topic: str, payload: str) -> None:
        self._client.publish(topic, payload, qos=1)

    def _take(self, topic: str, payload: bytes) -> None:
        if topic.startswith("spBv1.0/"):
            keys = set(_metric_names(payload))
        elif not payload:
            keys = {"(empty)"}
        else:
            try:
                keys = set(_keys(json.loads(payload)))
            except ValueError:
                keys = {"(no JSON)"}
        if f"{BASE}/alarms/" in topic and not any(
            topic.endswith(one) for one in (*_WANTED, "/shaft-vibration-x")
        ):
            return  # of the box itself, as a busy machine may raise them
        with self._lock:
            self._found.setdefault(topic, set()).update(keys)

    def topics(self) -> list[str]:
        with self._lock:
            return list(self._found)

    def found(self) -> dict[str, set[str]]:
        with self._lock:
            return {topic: set(keys) for topic, keys in self._found.items()}


def _keys(value: Any, path: str = "") -> Iterator[str]:
    """Paths of all keys in a JSON value; ``[]`` is any element of an array."""
    if isinstance(value, dict):
        for key, item in value.items():
            yield from _keys(item, f"{path}.{key}" if path else key)
    elif isinstance(value, list):
        if not value:
            yield path
        for item in value:
            yield from _keys(item, f"{path}[]")
    else:
        yield path


def _metric_names(payload: bytes) -> Iterator[str]:
    """Names of the metrics in a Sparkplug B payload: field 1 of each field 2 (protocol buffers)."""
    for number, value in _fields(payload):
        if number == 2 and isinstance(value, bytes):
            yield from (
                inner.decode() for field, inner in _fields(value) if field == 1 and isinstance(inner, bytes)
            )


def _fields(message: bytes) -> Iterator[tuple[int, bytes | int]]:
    at = 0

    def varint() -> int:
        nonlocal at
        value = shift = 0
        while True:
            byte = message[at]
            at += 1
            value |= (byte & 0x7F) << shift
            shift += 7
            if byte < 0x80:
                return value

    while at < len(message):
        key = varint()
        match key & 7:
            case 0:
                yield key >> 3, varint()
            case 2:
                length = varint()
                at += length
                yield key >> 3, message[at - length : at]
            case wire:
                at += {1: 8, 5: 4}[wire]


def _listed(title: str, found: dict[str, set[str]]) -> str:
    lines = [f"== {title}"]
    for name, keys in sorted(found.items()):
        lines += [name, *(f"  {key}" for key in sorted(_folded(keys)))]
    return "\n".join(lines) + "\n"


def _folded(keys: Iterable[str]) -> set[str]:
    """Without what is null or empty at one time and has an inside at another."""
    every = {_MODE.sub(r"\1MODE", key) for key in keys}
    return {
        key for key in every if not any(re.match(rf"{re.escape(key)}(\.|\[\])", other) for other in every)
    }


def _until(true: Callable[[], bool], what: str, heard: _Heard) -> None:
    until_s = time.monotonic() + PATIENCE_S
    while not true():
        if time.monotonic() > until_s:
            raise RuntimeError(f"{what} did not come; there were: {', '.join(sorted(heard.topics()))}")
        time.sleep(0.05)


@contextlib.contextmanager
def _running(command: list[str]) -> Iterator[subprocess.Popen[bytes]]:
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        yield process
    finally:
        process.terminate()
        try:
            process.wait(PATIENCE_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind((LOOPBACK, 0))
        port: int = probe.getsockname()[1]
        return port
