"""The discovery message of every example machine: in Home Assistant's terms, and with figures that exist."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
from home_assistant_rules import check_discovery, rendered
from machine_files import LAVAL, MACHINES

from daqsvc import assembly
from daqsvc.acquisition.clock import SystemClock
from daqsvc.alarms.events import Identity
from daqsvc.assembly_mqtt import mqtt_settings
from daqsvc.diagnosis.detector import Window
from daqsvc.publish.home_assistant import Discovery
from daqsvc.publish.payloads import diagnosis_payload
from daqsvc.publish.settings import HomeAssistantSettings, Reading
from daqsvc.publish.topics import Topics
from daqsvc.settings import parse_machine_file
from sim_hw.plants import rotor as plant
from sim_hw.plants.sensors import keyphasor_voltage

BROKER = '[mqtt]\nurl = "mqtts://broker.example"\n'
EXAMPLES = sorted(MACHINES.glob("*.toml"))


def machine(path):
    """An example machine with Home Assistant asked for."""
    text = path.read_text(encoding="utf-8")
    if "[mqtt]" not in text:
        text += f"\n{BROKER}"
    return parse_machine_file(f"{text}\n[mqtt.home_assistant]\n", path)


def discovery(path):
    told = machine(path)
    return Discovery(mqtt_settings(told).home_assistant, Topics("daqsvc", told.site, told.box))


@pytest.mark.parametrize("path", EXAMPLES, ids=[path.stem for path in EXAMPLES])
def test_every_example_machine_is_told_in_home_assistants_terms(path):
    told = discovery(path)
    payload = json.loads(json.dumps(told.payload()))
    check_discovery(told.topic, payload)
    names = {entity["unique_id"] for entity in payload["components"].values()}
    for alarm in machine(path).alarms:
        assert any(name.endswith(f"/alarm/{alarm.name}") for name in names)


def test_units_are_written_as_home_assistant_writes_them():
    settings = HomeAssistantSettings(
        "rig",
        readings=(
            Reading("d", "statistics", "rms", "um"),
            Reading("d", "statistics", "velocity_rms", "mm/s"),
            Reading("d", "statistics", "gap_voltage", "V"),
            Reading("d", "statistics", "value", "degC"),
            Reading("d", "probabilities", "F1"),
        ),
    )
    entities = Discovery(settings, Topics("daqsvc", "lab", "edge-1")).payload()["components"].values()
    shown = {e["name"]: (e.get("unit_of_measurement"), e.get("device_class")) for e in entities}
    assert shown == {
        "d rms": ("µm", None),
        "d velocity rms": ("mm/s", "speed"),
        "d gap voltage": ("V", "voltage"),
        "d value": ("°C", "temperature"),
        "d F1": (None, None),
    }


@pytest.mark.parametrize(
    ("unit", "small"),
    [("g", 0.012), ("m/s2", 0.12), ("mm/s", 0.28), ("um", 1.7), ("mil", 0.07), ("mm", 0.0017), ("V", 0.25)],
)
def test_the_level_of_a_smooth_machine_is_not_shown_as_nothing(unit, small):
    settings = HomeAssistantSettings("rig", readings=(Reading("d", "statistics", "rms", unit),))
    components = Discovery(settings, Topics("daqsvc", "lab", "edge-1")).payload()["components"]
    (digits,) = (entity["suggested_display_precision"] for entity in components.values())
    assert round(small, digits) == small


def test_names_that_differ_stay_apart():
    topics = Topics("daqsvc", "lab", "edge-1")
    told = {Discovery(HomeAssistantSettings(name), topics).topic for name in ("a.b", "a-b", "a_b", "a_2eb")}
    assert len(told) == 4
    settings = HomeAssistantSettings("rig", alarms=("a.b", "a-b", "a_b", "a_2eb"))
    assert len(Discovery(settings, topics).payload()["components"]) == 8


@pytest.mark.parametrize(
    "earlier", [b"", b"{", b"[]", b'{"components": 7}', b'{"components": {"x": 1}}', b"[" * 100_000]
)
def test_an_earlier_message_that_is_none_removes_nothing(earlier):
    told = Discovery(HomeAssistantSettings("rig", alarms=("a",)), Topics("daqsvc", "lab", "edge-1"))
    assert told.removals(earlier) == {}


@pytest.fixture(scope="module")
def said():
    """What the detectors of the example rig say in the end, by the topic that it goes to."""
    rig = machine(LAVAL)
    motion = plant.simulate(plant.RotorParameters(), [], revolutions=20.0, samples_per_rev=64.0)
    rng = np.random.default_rng(0)
    x, y = (um + 2.0 * rng.standard_normal(len(um)) for um in motion.in_um(100.0))
    samples = np.column_stack((x, y, keyphasor_voltage(motion.revolution))).astype(np.float32)
    period_ns = 1e9 / 640.0
    identity, clock = Identity(rig.site, rig.box, rig.machine.name), SystemClock()
    topics = Topics("daqsvc", rig.site, rig.box)
    last = {}
    for detector in assembly.detectors(rig):
        detector.warm()
        for begin in range(0, len(samples) - detector.block + 1, detector.block):
            part = samples[begin : begin + detector.block]
            window = Window(begin, part, round((begin + len(part) - 1) * period_ns), period_ns)
            for diagnosis in detector.process(window):
                payload = diagnosis_payload(identity, diagnosis, clock)
                last[topics.diagnosis(rig.machine.name, diagnosis.detector)] = json.loads(payload.to_json())
    return last


def test_every_figure_of_the_example_rig_is_one_that_its_detectors_tell(said):
    entities = discovery(LAVAL).payload()["components"].values()
    figures = [entity for entity in entities if "/diagnosis/" in entity["state_topic"]]
    assert len(figures) > 6
    for entity in figures:
        shown = rendered(entity["value_template"], said[entity["state_topic"]])
        assert math.isfinite(float(shown)), entity
        if "unit_of_measurement" in entity:
            key = entity["unique_id"].rpartition("/")[2]
            unit = said[entity["state_topic"]]["units"][key]
            assert entity["unit_of_measurement"] in {unit, "µm"}
