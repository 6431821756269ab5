"""The worked example of docs/drivers.md: installed as a third party's package is, it serves a machine."""

from __future__ import annotations

import importlib
import tomllib
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from brokers import eventually
from conformance.example_transport import LoggerDevice
from conformance.rig import samples_of
from live_service import running

from daqsvc.acquisition.clock import SystemClock
from daqsvc.settings import load_machine_file, parse_machine_file
from daqsvc.settings.problems import AssemblyError
from drivers.can.build import frame_layout
from drivers.make import bus_drivers

if TYPE_CHECKING:
    from daqsvc.settings import MachineFile

DOCS = Path(__file__).parents[2] / "docs"
EXAMPLE = DOCS / "example_driver"


@pytest.fixture(autouse=True)
def _installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Put the package where Python looks for packages, with the entry points that its project file states."""
    project = tomllib.loads((EXAMPLE / "pyproject.toml").read_text())["project"]
    info = tmp_path / "site" / f"{project['name'].replace('-', '_')}-{project['version']}.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text(
        f"Metadata-Version: 2.1\nName: {project['name']}\nVersion: {project['version']}\n"
    )
    (info / "entry_points.txt").write_text(
        "".join(
            f"[{group}]\n" + "".join(f"{name} = {value}\n" for name, value in points.items())
            for group, points in project["entry-points"].items()
        )
    )
    monkeypatch.syspath_prepend(str(info.parent))
    monkeypatch.syspath_prepend(str(EXAMPLE))
    importlib.invalidate_caches()


def machine(old: str = "", new: str = "") -> MachineFile:
    file = EXAMPLE / "machine.toml"
    return parse_machine_file(file.read_text().replace(old, new) if old else file.read_text(), file)


async def test_the_example_serves_a_machine(tmp_path: Path) -> None:
    logger = LoggerDevice(frame_layout(load_machine_file(EXAMPLE / "machine.toml"), "casing"))
    try:
        async with running(machine("4001", f"{logger.tcp_port}"), tmp_path / "store") as service:
            [driver] = service.drivers
            await eventually(lambda: driver.link.state == "up", "the logger is connected")
            ring = service.rings["casing"]
            await logger.send(0, samples_of(np.arange(600)))
            # The last frames are held until it is sure that none of before them is still to come.
            await eventually(lambda: ring.end_index >= 500, "the samples have arrived")
            np.testing.assert_array_equal(ring.read(0, 500), samples_of(np.arange(500)))
    finally:
        logger.close()


def test_an_option_that_is_of_no_use_is_named_with_its_bus() -> None:
    with pytest.raises(
        AssemblyError, match=r"machine.toml: buses.logger: tcp_port is '4001'; give it as int"
    ):
        bus_drivers(machine("= 4001", '= "4001"'), SystemClock(), lambda _: None)


def test_a_package_that_cannot_be_loaded_is_named_with_its_bus(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.modules", {**__import__("sys").modules, "tcp_frames": None})
    with pytest.raises(
        AssemblyError, match=r"buses.logger.driver = 'tcp-frames'.*cannot be loaded from tcp_f"
    ):
        bus_drivers(machine(), SystemClock(), lambda _: None)


def test_the_documentation_shows_the_example_as_it_is() -> None:
    text = (DOCS / "drivers.md").read_text()
    for name in ("tcp_frames.py", "pyproject.toml", "machine.toml"):
        assert (EXAMPLE / name).read_text().strip() in text, f"docs/drivers.md does not show {name} as it is"
