"""A real Home Assistant, a release from PyPI in a separate environment, set up by its REST interface.

It needs a newer Python than the service. The environment is made once and kept in ``.cache``;
``DAQSVC_HOME_ASSISTANT`` names one that is there already.
"""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import shutil
import subprocess
import time
import urllib.error
import urllib.parse
import urllib.request
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from support.paths import ROOT
from support.ports import free_port

if TYPE_CHECKING:
    from collections.abc import Iterator

RELEASES = {(3, 13): "2025.4.4", (3, 12): "2024.11.3"}
"""By the Python that it needs at least, the newest first; 2024.11 is the first with device discovery."""

INTEGRATIONS = ("auth", "config", "frontend", "history", "http", "mqtt", "onboarding", "recorder")
CONFIGURATION = """
http:
  server_host: 127.0.0.1
  server_port: {port}
api:
config:
onboarding:
recorder:
  commit_interval: 0
history:
logger:
  default: critical
"""
START_S = 120.0

# What these integrations need besides the release itself; run by its own Python.
_REQUIREMENTS = """
import importlib.util, json, pathlib, sys
home = pathlib.Path(importlib.util.find_spec("homeassistant").origin).parent / "components"
seen, wanted, todo = set(), set(), sys.argv[1:]
while todo:
    if (name := todo.pop()) not in seen:
        seen.add(name)
        manifest = json.loads((home / name / "manifest.json").read_text())
        wanted.update(manifest.get("requirements", []))
        todo.extend(manifest.get("dependencies", []))
print("\\n".join(sorted(wanted)))
"""


def environment() -> Path:
    """The folder of an environment with Home Assistant; skips where none can be made."""
    if path := os.environ.get("DAQSVC_HOME_ASSISTANT"):
        return Path(path)
    for (major, minor), release in RELEASES.items():
        python = _python(major, minor)
        if python is not None:
            (ROOT / ".cache").mkdir(exist_ok=True)
            # Tests run side by side: one of them makes it, the others wait.
            with (ROOT / ".cache" / "home-assistant.lock").open("w") as lock:
                fcntl.flock(lock, fcntl.LOCK_EX)
                return _made(python, release)
    pytest.skip("Home Assistant needs Python 3.12 or later, and there is none on the PATH")


def _python(major: int, minor: int) -> str | None:
    name = f"python{major}.{minor}"
    candidates = [
        shutil.which(name),
        *map(str, Path.home().glob(f".pyenv/versions/{major}.{minor}.*/bin/{name}")),
    ]
    for found in filter(None, candidates):
        # It may be a shim that runs nothing.
        done = subprocess.run([found, "-c", "import ensurepip, venv"], capture_output=True, check=False)
        if done.returncode == 0:
            return found
    return None


def _made(python: str, release: str) -> Path:
    folder = ROOT / ".cache" / f"home-assistant-{release}"
    ready = folder / ".ready"
    if ready.exists():
        return folder

    def run(*command: str) -> str:
        done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=900)
        if done.returncode != 0:
            shutil.rmtree(folder, ignore_errors=True)
            pytest.skip(f"Home Assistant {release} cannot be installed: {done.stderr.strip()[-500:]}")
        return done.stdout

    run(python, "-m", "venv", "--clear", str(folder))
    pip = (str(folder / "bin/python"), "-m", "pip", "install", "--quiet", "--disable-pip-version-check")
    run(*pip, f"homeassistant=={release}")
    wanted = run(str(folder / "bin/python"), "-c", _REQUIREMENTS, *INTEGRATIONS)
    run(*pip, *wanted.split())
    ready.touch()
    return folder


class HomeAssistant:
    """A running one, with an owner, connected to a broker."""

    def __init__(self, port: int) -> None:
        self._base = f"http://127.0.0.1:{port}"
        self._token = ""

    def set_up(self, broker_port: int) -> None:
        """What a person clicks through: an owner, then the MQTT integration."""
        settings = {
            "client_id": f"{self._base}/",
            "name": "t",
            "username": "t",
            "password": "t",
            "language": "en",
        }
        code = self._call("/api/onboarding/users", settings)["auth_code"]
        form = {"client_id": f"{self._base}/", "grant_type": "authorization_code", "code": code}
        self._token = self._call("/auth/token", form, as_form=True)["access_token"]
        flow = self._call("/api/config/config_entries/flow", {"handler": "mqtt"})["flow_id"]
        made = self._call(
            f"/api/config/config_entries/flow/{flow}", {"broker": "127.0.0.1", "port": broker_port}
        )
        assert (made["type"], made["result"]["state"]) == ("create_entry", "loaded"), made

    def entities(self) -> dict[str, dict[str, Any]]:
        """Every entity by the name that a person reads."""
        return {e["attributes"].get("friendly_name", e["entity_id"]): e for e in self._call("/api/states")}

    def press(self, entity_id: str) -> None:
        self._call("/api/services/button/press", {"entity_id": entity_id})

    def rows(self, entity_id: str) -> list[str]:
        """The states of an entity that are in the database."""
        history = self._call(
            f"/api/history/period?filter_entity_id={entity_id}&minimal_response&no_attributes"
        )
        return [row["state"] for row in history[0]] if history else []

    def answers(self) -> bool:
        """Whether it has started."""
        try:
            return bool(self._call("/api/onboarding"))
        except OSError:
            return False

    def _call(self, path: str, content: dict[str, Any] | None = None, *, as_form: bool = False) -> Any:
        data = None
        headers = {"Authorization": f"Bearer {self._token}"} if self._token else {}
        if content is not None:
            data = (urllib.parse.urlencode(content) if as_form else json.dumps(content)).encode()
            headers["Content-Type"] = "application/x-www-form-urlencoded" if as_form else "application/json"
        request = urllib.request.Request(self._base + path, data=data, headers=headers)  # noqa: S310
        with urllib.request.urlopen(request, timeout=30) as answer:  # noqa: S310  http on loopback
            return json.loads(answer.read())


@contextlib.contextmanager
def running_home_assistant(folder: Path, broker_port: int) -> Iterator[HomeAssistant]:
    """A Home Assistant that has just been installed, and knows the broker."""
    hass = environment() / "bin" / "hass"
    port = free_port()
    folder.mkdir()
    (folder / "configuration.yaml").write_text(CONFIGURATION.format(port=port), encoding="utf-8")
    with (folder / "log").open("wb") as log:
        process = subprocess.Popen([hass, "-c", folder, "--skip-pip"], stdout=log, stderr=log)
    server = HomeAssistant(port)
    try:
        until = time.monotonic() + START_S
        while not server.answers():
            assert process.poll() is None, (folder / "log").read_text("utf-8", errors="replace")[-3000:]
            assert time.monotonic() < until, "Home Assistant does not start"
            time.sleep(0.5)
        server.set_up(broker_port)
        yield server
    finally:
        process.terminate()
        try:
            process.wait(20)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
