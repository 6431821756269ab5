"""A detector by somebody else: its table, checks, sentence and alarms, without a line of ours changed."""

from __future__ import annotations

import json
from importlib.metadata import EntryPoint, entry_points
from typing import Annotated

import numpy as np
import pytest
from pydantic import Field
from support.machine_files import MACHINES, problems_of

from daqsvc.cli import main
from daqsvc.detectors.make import detectors
from daqsvc.diagnosis.detector import Window
from daqsvc.diagnosis.plugin import Detectability, DetectorPlugin, UnfitOptionError
from daqsvc.diagnosis.window_detector import Judgement, WindowDetector
from daqsvc.settings import describe, parse_machine_file, registry
from daqsvc.settings.problems import AssemblyError, Finding
from daqsvc.settings.section import Name, Section

EXAMPLE = MACHINES / "motor-accelerometer.toml"
TABLE = '[pipeline.kurtosis]\nsensor = "accel-de"\n'
ALARM = '[[alarms]]\nname = "impacts"\ndetector = "kurtosis"\n'


class Kurtosis(Section):
    """How peaked an acceleration is."""

    sensor: Annotated[Name, Field(description="the accelerometer", examples=["accel-de"])]
    most: Annotated[float, Field(ge=0, le=1000)] = Field(default=6.0, description="above it, it knocks")


class Knocks:
    """A detector, as far as this needs one."""

    stream = "drive-end"
    block = 1
    warm = process = silent = print

    def __init__(self, sensor):
        self.name = "kurtosis"
        self.sensor = sensor


class KurtosisPlugin(DetectorPlugin[Kurtosis]):
    settings = Kurtosis
    about = "knocks in an acceleration"
    detector = "kurtosis"

    def checks(self, draft, given):
        def known():
            if given.sensor not in {sensor.name for sensor in draft.sensors}:
                yield Finding(("pipeline", "kurtosis", "sensor"), "there is no such sensor", "name another")

        yield known()

    def describe(self, machine, given):
        return f"knocks of {given.sensor} above {given.most:g}"

    def build(self, machine, given, store):
        return (Knocks(given.sensor),)


@pytest.fixture
def installed(monkeypatch):
    """Have these entry points besides ours, by key and place."""

    def install(**places):
        theirs = [EntryPoint(key, place, registry.DETECTORS) for key, place in places.items()]

        def found(group):
            return [*entry_points(group=group), *(point for point in theirs if point.group == group)]

        monkeypatch.setattr(registry, "entry_points", found)
        registry.forget()

    yield install
    monkeypatch.undo()
    registry.forget()


def text(*more):
    return "\n".join([EXAMPLE.read_text(), *more])


def the_problem(faulty):
    (problem,) = problems_of(faulty, EXAMPLE)
    return problem


def test_its_table_is_read_and_its_detector_made(installed):
    installed(kurtosis=f"{__name__}:KurtosisPlugin")
    machine = parse_machine_file(text(TABLE, ALARM), EXAMPLE)
    assert machine.pipeline.table(Kurtosis) == Kurtosis(sensor="accel-de")
    assert machine.detectors == ("kurtosis",)
    assert "knocks of accel-de above 6" in " ".join(describe(machine).split())
    assert [d.sensor for d in detectors(machine) if d.name == "kurtosis"] == ["accel-de"]


def test_what_is_wrong_in_it_is_said_as_of_any_table(installed):
    installed(kurtosis=f"{__name__}:KurtosisPlugin")
    misspelt = the_problem(text('[pipeline.kurtosis]\nsensor = "accel-de"\nmots = 3.0'))
    assert "pipeline.kurtosis.mots = 3.0: unknown key. Remedy: did you mean most?" in str(misspelt)
    bounded = the_problem(text('[pipeline.kurtosis]\nsensor = "accel-de"\nmost = -1'))
    assert (bounded.key, bounded.message) == ("pipeline.kurtosis.most", "must be 0 or more")
    missing = the_problem(text("[pipeline.kurtosis]"))
    remedy = 'the accelerometer. Remedy: add sensor = "accel-de" to [pipeline.kurtosis] [F06]'
    assert str(missing).endswith(remedy)
    nobody = the_problem(text('[pipeline.kurtosis]\nsensor = "nowhere"'))
    assert (nobody.key, nobody.message) == ("pipeline.kurtosis.sensor", "there is no such sensor")


def test_without_it_its_table_is_no_table(installed):
    installed()
    assert {p.key for p in problems_of(text(TABLE, ALARM), EXAMPLE)} == {
        "pipeline.kurtosis",
        f"alarms[{text(ALARM).count('[[alarms]]') - 1}].detector",
    }


def test_one_that_cannot_be_loaded_is_said_where_it_is_asked_for(installed):
    installed(kurtosis="nobody_has_this:KurtosisPlugin")
    assert parse_machine_file(text(), EXAMPLE).detectors == ()
    problem = the_problem(text(TABLE))
    assert "the detector cannot be loaded from nobody_has_this:KurtosisPlugin: No module" in str(problem)
    assert "install the package that brings it again, or remove [pipeline.kurtosis]" in str(problem)
    assert problem.line == text(TABLE).splitlines().index("[pipeline.kurtosis]") + 1


class Misnamed(KurtosisPlugin):
    def build(self, machine, given, store):
        made = Knocks(given.sensor)
        made.name = "kurt"
        return (made,)


class Twice(KurtosisPlugin):
    def build(self, machine, given, store):
        return Knocks(given.sensor), Knocks(given.sensor)


class Nowhere(KurtosisPlugin):
    def build(self, machine, given, store):
        made = Knocks(given.sensor)
        made.stream = "nowhere"
        return [made]


class Standing(KurtosisPlugin):
    def build(self, machine, given, store):
        made = Knocks(given.sensor)
        made.block = 0
        return [made]


class Nobody(KurtosisPlugin):
    def build(self, machine, given, store):
        return []


@pytest.mark.parametrize(
    ("plugin", "words"),
    [
        ("Nobody", "the plugin of 'kurtosis' makes no detector, and alarm 'impacts' follows it; remove the"),
        ("Misnamed", "the plugin of 'kurtosis' makes a detector 'kurt', which no alarm follows"),
        ("Twice", "two detectors are named 'kurtosis'"),
        ("Nowhere", "Nowhere has failed: its kurtosis takes 1 samples of 'nowhere'; have it take"),
        (
            "Standing",
            "Standing has failed: its kurtosis takes 0 samples of 'drive-end'; have it",
        ),
    ],
)
def test_detectors_that_no_alarm_can_tell_are_refused(installed, plugin, words):
    installed(kurtosis=f"{__name__}:{plugin}")
    with pytest.raises(AssemblyError, match=words):
        detectors(parse_machine_file(text(TABLE, ALARM), EXAMPLE))


class Peak(WindowDetector):
    """Says what it is told to."""

    answer = Judgement("alert", {"peak": 2.0}, units={"peak": "g"}, thresholds={"peak.alert": 1.0})

    def judge(self, samples):
        return self.answer


def one_window(made, machine):
    columns = len(machine.streams[made.stream].layout.channel_names)
    samples = np.zeros((made.block, columns), np.float32)
    return made.process(Window(0, samples, 10**9, 1e9 / made.block))


def test_a_judgement_is_shown_with_units_and_thresholds():
    machine = parse_machine_file(text(), EXAMPLE)
    [said] = one_window(Peak(machine, "peak", ["accel-de"], 0.5), machine)
    assert (said.severity, said.statistics, said.units) == ("alert", {"peak": 2.0}, {"peak": "g"})
    assert said.thresholds == {"peak.alert": 1.0}


def test_a_judgement_that_nobody_can_read_is_refused():
    with pytest.raises(ValueError, match="no severity 'WARNING'; take one of: alert, danger, normal"):
        Judgement("WARNING")
    with pytest.raises(ValueError, match="peak is 'much', which is not a number"):
        Judgement("alert", {"peak": "much"})
    with pytest.raises(ValueError, match="its units are 3; give them by name, as a dict"):
        Judgement("alert", {"peak": 1.0}, units=3)
    with pytest.raises(ValueError, match="peak is 3, which is not a text"):
        Judgement("alert", {"peak": 1.0}, units={"peak": 3})
    with pytest.raises(ValueError, match="decision is 7, which is not a text"):
        Judgement("alert", decision=7)
    machine = parse_machine_file(text(), EXAMPLE)
    made = Peak(machine, "peak", ["accel-de"], 0.5)
    made.answer = None
    with pytest.raises(TypeError, match="it returns None, not Judgement"):
        one_window(made, machine)


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ({"statistics": {"peak": np.nan}}, "peak is nan; give a finite number"),
        ({"statistics": {"peak": np.float32(-np.inf)}}, "peak is -inf; give a finite number"),
        ({"statistics": {"peak": 10**400}}, "peak is 1000.*; give a finite number"),
        ({"thresholds": {"peak.alert": np.inf}}, "peak.alert is inf; give a finite number"),
        ({"statistics": {5: 1.0}}, "5 in its statistics is no name; give a text of 200"),
        ({"statistics": {"a\0": 1.0}}, r"'a.x00' in its statistics is no name"),
        ({"thresholds": {"\ud800": 1.0}}, "in its thresholds is no name"),
        ({"units": {"peak": "\ud800"}}, "peak is '.ud800'; give a text of 200"),
        ({"decision": "a" * 201}, "decision is 'aaa.*; give a text of 200"),
        ({"statistics": {f"k{k}": 1.0 for k in range(1001)}}, "it has 1001 statistics; give 1000 at most"),
    ],
)
def test_a_judgement_that_cannot_be_sent_or_held_against_a_limit_is_refused(fields, words):
    with pytest.raises(ValueError, match=words):
        Judgement("alert", **fields)


@pytest.mark.parametrize("window_s", [0, -1.0, np.nan, np.inf, 1e5, "one", None])
def test_a_window_that_no_ring_holds_is_refused(window_s):
    machine = parse_machine_file(text(), EXAMPLE)
    most_s = machine.pipeline.ring_s / 2
    with pytest.raises(AssemblyError) as refused:
        Peak(machine, "peak", ["accel-de"], window_s)
    bounds = f"window_s is {window_s!r}; make it a number above 0 and at most {most_s:g}, so"
    assert str(refused.value).startswith(f"detector peak: {bounds}")
    Peak(machine, "peak", ["accel-de"], most_s)


def test_sensors_that_are_not_sampled_together_are_refused():
    two = MACHINES / "rotor-two-buses.toml"
    machine = parse_machine_file(two.read_text(), two)
    names = [sensor.name for sensor in machine.sensors]
    assert len({machine.sensor(name).stream for name in names}) > 1
    with pytest.raises(AssemblyError, match=r"takes samples of one stream .* give it sensors of one"):
        Peak(machine, "peak", names, 0.5)
    with pytest.raises(
        AssemblyError, match=r"detector peak \(.*\) takes samples of 'nosuch', which is no sensor; name"
    ):
        Peak(machine, "peak", ["nosuch"], 0.5)


class Predictable(KurtosisPlugin):
    predictable = True

    def detectability(self, machine, given, options):
        if options.process_noise is not None:
            raise UnfitOptionError("--process-noise: knocks have none; leave it out")
        if options.noise_um is not None:
            raise ValueError("accelerometers measure no um [C01]")
        return Detectability({"sensor": given.sensor, "most": given.most}, f"{given.sensor} sees all")


def test_what_it_can_see_is_said_by_daqsvc_detectability(installed, tmp_path, capsys):
    path = tmp_path / "m.toml"
    path.write_text(text(TABLE))

    def verb(*options):
        code = main(["detectability", str(path), *options])
        return code, "".join(capsys.readouterr()).removeprefix(f"{path}: ").rstrip()

    installed(kurtosis=f"{__name__}:KurtosisPlugin")
    assert verb()[0] == 2
    installed(kurtosis=f"{__name__}:Predictable")
    assert verb() == (0, "accel-de sees all")
    assert json.loads(verb("--json")[1]) == {"sensor": "accel-de", "most": 6.0}
    assert verb("--process-noise", "1") == (2, "--process-noise: knocks have none; leave it out [C01]")
    assert verb("--noise-um", "1") == (1, "accelerometers measure no um [C01]")
    path.write_text(text())
    code, said = verb()
    assert code == 2
    assert said.startswith(
        "there is neither [pipeline.rotor_bank] nor [pipeline.rotor_synchronous] nor [pipeline.k"
    )
    assert said.endswith("[F06]")
