"""The discovery message of every example machine: in Home Assistant's terms, and with figures that exist."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
from support.home_assistant_rules import check_discovery, rendered
from support.machine_files import LAVAL, MACHINES
from support.mqtt_publishing import commands

from daqsvc.acquisition.clock import SystemClock
from daqsvc.detectors.make import detectors
from daqsvc.diagnosis.detector import Window
from daqsvc.diagnosis.reading import Reading
from daqsvc.publish.home_assistant.discovery import Discovery
from daqsvc.publish.home_assistant.readings import Readings
from daqsvc.publish.home_assistant.settings import HomeAssistant
from daqsvc.publish.make import watched
from daqsvc.publish.mqtt.commands import CommandPayload
from daqsvc.publish.mqtt.settings import Mqtt
from daqsvc.publish.output import Watched
from daqsvc.publish.topics import Topics
from daqsvc.settings import parse_machine_file
from sim_hw.plants import rotor as plant
from sim_hw.plants.rotor import keyphasor_voltage

BROKER = '[mqtt]\nurl = "mqtts://broker.example"\n'
NONE = commands()
EXAMPLES = sorted(MACHINES.glob("*.toml"))


def machine(path):
    """An example machine with Home Assistant asked for."""
    text = path.read_text(encoding="utf-8")
    if "[mqtt]" not in text:
        text += f"\n{BROKER}"
    return parse_machine_file(f"{text}\n[mqtt.home_assistant]\n", path)


def discovery(path):
    told = machine(path)
    settings = told.output(HomeAssistant), told.output(Mqtt).commands
    return Discovery(*settings, watched(told), Topics("daqsvc", told.site, told.box))


def told_of(machine, box="edge-1", commands=NONE):
    return Discovery(HomeAssistant(), commands, machine, Topics("daqsvc", "lab", box))


@pytest.mark.parametrize("path", EXAMPLES, ids=[path.stem for path in EXAMPLES])
def test_every_example_machine_is_told_in_home_assistants_terms(path):
    told = discovery(path)
    payload = json.loads(json.dumps(told.payload()))
    check_discovery(told.topic, payload)
    names = {entity["unique_id"] for entity in payload["components"].values()}
    for alarm in machine(path).alarms:
        assert any(name.endswith(f"/alarm/{alarm.name}") for name in names)


def test_units_are_written_as_home_assistant_writes_them():
    rig = Watched(
        "rig",
        readings=(
            Reading("d", "statistics", "rms", "um"),
            Reading("d", "statistics", "velocity_rms", "mm/s"),
            Reading("d", "statistics", "gap_voltage", "V"),
            Reading("d", "statistics", "value", "degC"),
            Reading("d", "statistics", "state", "1"),
            Reading("d", "probabilities", "F1"),
        ),
    )
    entities = told_of(rig).payload()["components"].values()
    shown = {e["name"]: (e.get("unit_of_measurement"), e.get("device_class")) for e in entities}
    assert shown == {
        "d rms": ("µm", None),
        "d velocity rms": ("mm/s", "speed"),
        "d gap voltage": ("V", "voltage"),
        "d value": ("°C", "temperature"),
        "d state": (None, None),
        "d F1": (None, None),
    }


@pytest.mark.parametrize(
    ("unit", "small"),
    [("g", 0.012), ("m/s2", 0.12), ("mm/s", 0.28), ("um", 1.7), ("mil", 0.07), ("mm", 0.0017), ("V", 0.25)],
)
def test_the_level_of_a_smooth_machine_is_not_shown_as_nothing(unit, small):
    rig = Watched("rig", readings=(Reading("d", "statistics", "rms", unit),))
    components = told_of(rig).payload()["components"]
    (digits,) = (entity["suggested_display_precision"] for entity in components.values())
    assert round(small, digits) == small


def test_names_that_differ_stay_apart():
    told = {told_of(Watched(name)).topic for name in ("a.b", "a-b", "a_b", "a_2eb")}
    assert len(told) == 4
    rig = Watched("rig", alarms=("a.b", "a-b", "a_b", "a_2eb"))
    assert len(told_of(rig).payload()["components"]) == 12


@pytest.mark.parametrize(
    "earlier", [b"", b"{", b"[]", b'{"components": 7}', b'{"components": {"x": 1}}', b"[" * 100_000]
)
def test_an_earlier_message_that_is_none_removes_nothing(earlier):
    told = told_of(Watched("rig", alarms=("a",)))
    assert told.removals(earlier) == {}


@pytest.fixture(scope="module")
def said():
    """What the detectors of the example rig say in the end, by the topic that it goes to."""
    rig = machine(LAVAL)
    motion = plant.simulate(plant.PlantParameters(), [], revolutions=20.0, samples_per_rev=64.0)
    rng = np.random.default_rng(0)
    x, y = (um + 2.0 * rng.standard_normal(len(um)) for um in motion.in_um(100.0))
    samples = np.column_stack((x, y, keyphasor_voltage(motion.revolution))).astype(np.float32)
    period_ns = 1e9 / 640.0
    topics = Topics("daqsvc", rig.site, rig.box)
    readings = Readings(rig.output(HomeAssistant), watched(rig), topics, SystemClock())
    units = {}
    for detector in detectors(rig):
        detector.warm()
        for begin in range(0, len(samples) - detector.block + 1, detector.block):
            part = samples[begin : begin + detector.block]
            window = Window(begin, part, round((begin + len(part) - 1) * period_ns), period_ns)
            for diagnosis in detector.process(window):
                readings.note(diagnosis)
                units |= {(diagnosis.detector, key): unit for key, unit in diagnosis.units.items()}
    return {topic: json.loads(payload) for topic, payload in readings.due()}, units


def test_every_figure_of_the_example_rig_is_one_that_its_detectors_tell(said):
    told, units = said
    entities = discovery(LAVAL).payload()["components"].values()
    figures = [entity for entity in entities if "state_class" in entity]
    assert len(figures) > 6
    for entity in figures:
        payload = told[entity["state_topic"]]
        shown = rendered(entity["value_template"], payload)
        assert math.isfinite(float(shown)), entity
        if "unit_of_measurement" in entity:
            key = entity["unique_id"].rpartition("/")[2]
            assert entity["unit_of_measurement"] in {units[payload["detector"], key], "µm"}
    (finding,) = [entity for entity in entities if "/finding/" in entity["unique_id"]]
    assert rendered(finding["value_template"], told[finding["state_topic"]]) == "N"


def test_buttons_ask_for_what_the_box_would_obey():
    rig = machine(LAVAL)
    entities = discovery(LAVAL).payload()["components"].values()
    buttons = [entity for entity in entities if entity["platform"] == "button"]
    allowed = {verb for verb in ("acknowledge", "reset") if verb in rig.output(Mqtt).commands.allow}
    assert rig.output(Mqtt).commands.enabled
    assert len(buttons) == len(allowed) * len(rig.alarms) > 0
    for button in buttons:
        # The templates in it, as Home Assistant fills them.
        text = button["command_template"].replace("{{ utcnow().isoformat() }}", "2026-11-22T08:00:00+00:00")
        text = text.replace("{{ utcnow().timestamp() }}", "1795331234.123456")
        text = text.replace("{{ '%05d' % (range(100000) | random) }}", "00042")
        command = CommandPayload.model_validate_json(text)
        verb = button["command_topic"].rpartition("/")[2]
        assert button["command_topic"] == f"daqsvc/{rig.site}/{rig.box}/{rig.machine.name}/commands/{verb}"
        assert verb in allowed
        assert button["unique_id"].endswith(f"/{verb}/{command.alarm}")
    off = rig.output(Mqtt).commands.model_copy(update={"enabled": False})
    for silent in (NONE, off):
        none = told_of(watched(rig), commands=silent).payload()["components"]
        assert not [entity for entity in none.values() if entity["platform"] == "button"]


def test_names_read_right_beside_problem_and_boxes_stay_apart():
    pump = Watched(
        "pump", alarms=("shaking",), services=("sensor-ok/probe-x", "detector-ok/bearing", "store/disk")
    )
    told = [told_of(pump, box).payload() for box in ("one", "two")]
    assert [payload["device"]["name"] for payload in told] == ["pump (lab/one)", "pump (lab/two)"]
    problems = {e["name"] for e in told[0]["components"].values() if e["platform"] == "binary_sensor"}
    assert problems == {"shaking", "probe-x sensor fault", "bearing detector fault", "store/disk"}
    ids = [{e["unique_id"] for e in payload["components"].values()} for payload in told]
    assert ids[0].isdisjoint(ids[1])
