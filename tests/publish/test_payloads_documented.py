"""The examples of docs/mqtt.md and docs/status.md are payloads, key by key, as the example rig gives them."""

from __future__ import annotations

import json
import re

import numpy as np
import pytest
from support.paths import ROOT

from daqsvc.alarms.events import EventKind
from daqsvc.alarms.states import AlarmState
from daqsvc.box import Box
from daqsvc.detectors.make import detectors
from daqsvc.diagnosis.detector import Window
from daqsvc.publish.schemas import PAYLOADS
from daqsvc.service import Service
from daqsvc.settings import load_machine_file
from sim_hw.plants import rotor as plant
from sim_hw.plants.rotor import keyphasor_voltage

RIG = load_machine_file(ROOT / "config" / "machines" / "laval-rig.toml")
TEXT = (ROOT / "docs" / "mqtt.md").read_text(encoding="utf-8")
EXAMPLES = {
    example["schema"]: example
    for text in (TEXT, (ROOT / "docs" / "status.md").read_text(encoding="utf-8"))
    for example in map(json.loads, re.findall(r"```json\n(.*?)```", text, re.DOTALL))
}


@pytest.mark.parametrize("schema", sorted(PAYLOADS))
def test_every_payload_has_an_example_that_is_one(schema):
    payload = PAYLOADS[schema].model_validate_json(json.dumps(EXAMPLES[schema]))
    # What may be left out of a command stands in it or not; what is published has all its keys.
    taken_in = schema in {"daqsvc.command/1", "daqsvc.snapshot-command/1"}
    assert json.loads(payload.model_dump_json(by_alias=True, exclude_unset=taken_in)) == EXAMPLES[schema]


@pytest.mark.parametrize("word", [*AlarmState, *EventKind])
def test_every_state_and_kind_is_explained(word):
    assert f"`{word.value}`" in TEXT


def shape(figures):
    """The names in a tree of figures."""
    return {
        name: shape(below) if isinstance(below, dict) and below else None for name, below in figures.items()
    }


def test_the_documented_status_has_the_figures_of_the_example_rig(tmp_path):
    figures = Service(Box.single(RIG), tmp_path).figures()
    assert shape(EXAMPLES["daqsvc.status/1"]["figures"]) == shape(figures)


@pytest.fixture(scope="module")
def said():
    """What the detectors of the example rig say, by detector, as its rotor loses damping in the end."""
    motion = plant.simulate(
        plant.PlantParameters(),
        [plant.Change(15.0, plant.PlantParameters(damping_ratio=0.10))],
        revolutions=30.0,
        samples_per_rev=64.0,
    )
    rng = np.random.default_rng(0)
    x, y = (um + 2.0 * rng.standard_normal(len(um)) for um in motion.in_um(100.0))
    samples = np.column_stack((x, y, keyphasor_voltage(motion.revolution))).astype(np.float32)
    period_ns = 1e9 / 640.0
    last = {}
    for detector in detectors(RIG):
        detector.warm()
        for begin in range(0, len(samples) - detector.block + 1, detector.block):
            part = samples[begin : begin + detector.block]
            window = Window(begin, part, round((begin + len(part) - 1) * period_ns), period_ns)
            last |= {diagnosis.detector: diagnosis for diagnosis in detector.process(window)}
    return last


@pytest.mark.long
@pytest.mark.parametrize(
    "documented",
    [EXAMPLES["daqsvc.alarm/1"]["cause"], EXAMPLES["daqsvc.diagnosis/1"]],
    ids=["alarm", "diagnosis"],
)
def test_the_documented_statements_are_such_as_the_example_rig_makes(documented, said):
    real = said[documented["detector"]]
    for figures in ("probabilities", "statistics", "thresholds", "evidence"):
        assert set(documented[figures]) == set(getattr(real, figures)), figures
    assert documented["units"] == dict(real.units)
    assert documented["thresholds"] == dict(real.thresholds)
    assert (tuple(documented["sensors"]), documented["model"]) == (real.sensors, real.model)
    assert (documented["window"]["stream"], documented["quality"]) == (real.stream, real.quality)
    if real.detector == "rotor-bank":
        assert (documented["decision"], documented["severity"]) == (real.decision, real.severity)
