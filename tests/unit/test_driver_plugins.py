"""Which driver a table of the machine file belongs to, and what becomes of one that is not installed."""

from __future__ import annotations

import pytest
from machine_files import LAVAL, changed, problems_of

from daqsvc.acquisition.clock import SystemClock
from daqsvc.settings import load_machine_file, registry
from daqsvc.settings.buses import UnknownBus
from drivers.base import BusCounters
from drivers.make import bus_driver, bus_self_checks
from drivers.plugin import DriverPlugin

BUS = 'driver = "can"'


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


def test_options_that_are_changed_reach_the_driver():
    machine = load_machine_file(LAVAL)
    driver = bus_driver(machine, "can0", SystemClock(), lambda _block: None, {"channel": "other"})
    assert "other" in driver.link.name


def test_what_can_be_watched_of_a_bus_its_driver_says():
    assert bus_self_checks(load_machine_file(LAVAL)) == {"can0": ("overrun", "controller", "recording")}
    counters = BusCounters()
    assert (counters.overruns, counters.controller_state, counters.frames_unrecorded) == (0, None, 0)
