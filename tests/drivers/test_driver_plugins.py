"""Which driver a table of the machine file belongs to, and what becomes of one that is not installed."""

from __future__ import annotations

import json
import tomllib
from importlib.metadata import EntryPoint, entry_points
from types import SimpleNamespace
from typing import Annotated, Literal

import pytest
from pydantic import Field
from support.bus_tables import line_layout, table_layout
from support.machine_files import LAVAL, MOTOR, changed, problems_of
from support.machine_mutations import toml
from support.modbus_layouts import register, registers_layout

from daqsvc.settings import load_machine_file, parse_machine_file, registry
from daqsvc.settings.buses import Bus, Layout, UnknownBus
from daqsvc.settings.section import Name  # noqa: TC001 - pydantic reads the annotations
from drivers.base import BusCounters
from drivers.make import bus_self_checks, stream_layout
from drivers.plugin import DriverPlugin, in_units

BUS = 'driver = "can"'


class PulseBus(Bus):
    """A bus of somebody else, whose frames are described in words of its own."""

    kind = "a pulse counter"

    driver: Literal["pulses"]


class PulseLayout(Layout):
    """Pulses by input."""

    kind = "a layout of pulses"
    mark = "inputs"
    channels_key = "inputs"

    inputs: Annotated[tuple[Name, ...], Field(strict=False, min_length=1, description="names of the inputs")]

    @property
    def channel_names(self):
        return self.inputs


class PulsePlugin(DriverPlugin[PulseBus]):
    buses = (PulseBus,)
    layouts = (PulseLayout,)
    self_checks = ("overrun",)

    def stream_layout(self, machine, stream):
        return machine.streams[stream].layout.inputs


@pytest.fixture
def pulses(monkeypatch):
    """Have a driver of somebody else, with a kind of layout of its own."""
    theirs = EntryPoint("pulses", f"{__name__}:PulsePlugin", registry.DRIVERS)

    def found(group):
        return [*entry_points(group=group), *([theirs] if group == registry.DRIVERS else [])]

    monkeypatch.setattr(registry, "entry_points", found)
    registry.forget()
    yield
    monkeypatch.undo()
    registry.forget()


def of_pulses(inputs):
    """The motor's machine file with its bus and its one layout exchanged."""
    text = MOTOR.read_text()
    document = tomllib.loads(text)
    [bus], [stream] = document["buses"], document["streams"]
    document["buses"][bus] = {"driver": "pulses"}
    document["streams"][stream]["layout"] = {"inputs": inputs}
    return "".join(f"{json.dumps(key)} = {toml(value)}\n" for key, value in document.items()), stream


@pytest.fixture
def without_drivers(monkeypatch):
    monkeypatch.setattr(registry, "entry_points", lambda group: [])
    registry.forget()
    yield
    monkeypatch.undo()
    registry.forget()


def test_our_drivers_come_in_by_the_door_of_others():
    tables = registry.bus_tables()
    assert list(tables)[:4] == ["can", "modbus", "serial", "replay"]
    assert all(isinstance(plugin, DriverPlugin) for plugin in tables.values())
    assert registry.broken_drivers() == {}
    kinds = [kind for plugin in tables.values() for kind in (*plugin.buses, *plugin.layouts)]
    assert all(kind.kind for kind in kinds), "each is called something in messages"
    marks = {(plugin, kind.mark) for plugin in tables.values() for kind in plugin.layouts}
    assert len({mark for _, mark in marks}) == len(marks), "a table is of one driver"


def test_a_bus_of_a_driver_that_is_not_there_has_one_error():
    text, line = changed(LAVAL, (BUS, 'driver = "cna"'))
    [problem] = problems_of(text, LAVAL)
    assert (problem.line, problem.key, problem.message) == (
        line,
        "buses.can0.driver",
        "no such driver is installed",
    )
    assert problem.remedy.startswith('did you mean "can"?')


@pytest.mark.usefixtures("without_drivers")
def test_where_no_driver_is_installed_each_bus_says_so():
    problems = problems_of(LAVAL.read_text(), LAVAL)
    assert {problem.key for problem in problems} >= {"buses.can0.driver"}
    assert all("no such driver is installed" in p.message for p in problems if p.key.startswith("buses"))
    assert registry.BUSES.choose({"driver": "can"}) is UnknownBus


@pytest.mark.usefixtures("pulses")
def test_a_layout_is_known_by_its_mark_and_decoded_by_who_brings_it():
    names = [sensor.channel for sensor in load_machine_file(MOTOR).sensors]
    text, stream = of_pulses(names)
    machine = parse_machine_file(text, MOTOR)
    assert isinstance(machine.streams[stream].layout, PulseLayout)
    assert stream_layout(machine, stream) == tuple(names)
    assert set(bus_self_checks(machine).values()) == {("overrun",)}
    twice, _ = of_pulses([*names, names[0]])
    assert "is the name of an earlier channel already" in str(problems_of(twice, MOTOR)[0])


@pytest.mark.usefixtures("pulses")
def test_layouts_of_other_drivers_are_said_to_be_none_of_a_bus():
    names = [sensor.channel for sensor in load_machine_file(MOTOR).sensors]
    text, stream = of_pulses(names)
    elsewhere = text.replace(
        '"driver" = "pulses"', '"driver" = "can", "interface" = "virtual", "channel" = "a"'
    )
    [problem] = [p for p in problems_of(elsewhere, MOTOR) if p.key == f"streams.{stream}.layout"]
    [bus] = load_machine_file(MOTOR).buses
    assert problem.message == f'is a layout of pulses, and bus "{bus}" is a CAN bus'


UNITS = SimpleNamespace(sensors=[SimpleNamespace(channel="x", stream="s", gain=2.0, shift=5.0)])


@pytest.mark.parametrize(
    "layout",
    [
        registers_layout(1, "holding", [register("x", 0, "int16", scale=0.5, offset=-3.0)]),
        line_layout(("n", "x"), [{"name": "x", "scale": 0.5, "offset": -3.0}], counter="n"),
        table_layout(("x", "column", 0.5, -3.0)),
    ],
    ids=["registers", "line", "table"],
)
def test_a_layout_is_put_in_the_units_of_its_sensors(layout):
    turned = in_units(layout, UNITS, "s")
    [channel] = getattr(turned, turned.channels_key)
    assert (channel.scale, channel.offset) == (1.0, -1.0)
    assert in_units(layout, UNITS, "another") == layout


def test_what_can_be_watched_of_a_bus_its_driver_says():
    assert bus_self_checks(load_machine_file(LAVAL)) == {"can0": ("overrun", "controller", "recording")}
    counters = BusCounters()
    assert (counters.overruns, counters.controller_state, counters.frames_unrecorded) == (0, None, 0)
