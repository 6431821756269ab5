"""The worked example of docs/detectors.md: raised by knocks, held where samples are missing."""

from __future__ import annotations

import importlib
import json
import re
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from support.example_packages import DETECTOR, DOCS, installed
from support.machine_files import MOTOR, problems_of

from daqsvc import api
from daqsvc.alarms.make import alarm_rule
from daqsvc.alarms.rules import Circumstances
from daqsvc.cli import main
from daqsvc.detectors.make import detectors
from daqsvc.diagnosis.detector import Window
from daqsvc.diagnosis.window_detector import Judgement
from daqsvc.settings import describe, parse_machine_file

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    from daqsvc.settings import MachineFile

pytestmark = pytest.mark.integration
TABLE = '[pipeline.crest]\nsensor = "accel-de"\nalert = 5.0\n'
RATE_HZ = 10_000
ALARM = '[[alarms]]\nname = "knocks"\ndetector = "crest"\n'


@pytest.fixture(autouse=True)
def _installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    yield from installed(DETECTOR, tmp_path / "site", monkeypatch)


def machine(*more: str) -> MachineFile:
    return parse_machine_file("\n".join([MOTOR.read_text(), *(more or (TABLE, ALARM))]), MOTOR)


def detector() -> Any:
    [found] = [detector for detector in detectors(machine()) if detector.name == "crest"]
    return found


def window(made: Any, signal: NDArray[Any], first: int = 0) -> Window:
    samples = np.zeros((len(signal), len(machine().streams[made.stream].layout.channel_names)), np.float32)
    samples[:, made._columns[0]] = signal
    return Window(first, samples, 10**9, 1e9 / made.block)


def test_its_alarm_follows_it() -> None:
    assert "crest" in machine().detectors
    assert "knocks" in [rule.alarm for rule in map(alarm_rule, machine().alarms)]
    assert "sensor accel-de, alert 5.0" in " ".join(describe(machine()).split())


def test_knocks_raise_it_and_their_end_clears_it() -> None:
    made = detector()
    made.warm()
    t = np.arange(2 * made.block) / made.block
    quiet = np.sin(2 * np.pi * 50 * t)
    knocking = quiet.copy()
    knocking[made.block // 2] = 40.0
    first, second = made.process(window(made, knocking))
    assert (first.decision, first.severity, first.changed, first.quality) == ("alert", "alert", True, "good")
    assert first.statistics["crest_factor"] == pytest.approx(
        np.abs(knocking[: made.block]).max() / knocking[: made.block].std(), rel=1e-2
    )
    assert (second.decision, second.changed) == ("normal", True)
    assert second.statistics["crest_factor"] == pytest.approx(np.sqrt(2), rel=1e-2)
    assert (first.first_index, first.end_index, second.end_index) == (0, made.block, 2 * made.block)
    assert second.t_ns - first.t_ns == pytest.approx(1e9, rel=1e-6)


@pytest.mark.parametrize(
    ("judgement", "said"),
    [
        (None, r"crest finds alert, crest_factor is \d\d\.\d\d, alert limit 5"),
        (
            Judgement("danger", {"n": 1, "rms": 9.7}, units={"rms": "mm/s"}, thresholds={"rms.danger": 7.1}),
            "crest finds danger, rms is 9.7 mm/s, danger limit 7.1 mm/s",
        ),
        (Judgement("alert", {"a": 1, "b": 2.5}, decision="rub"), "crest finds rub, a is 1, b is 2.5"),
        (Judgement("alert"), "crest finds alert"),
    ],
)
def test_its_alarm_says_the_figure_and_its_limit(judgement: Judgement | None, said: str) -> None:
    made = detector()
    if judgement is not None:
        made.judge = lambda _: judgement
    knocking = np.sin(np.arange(made.block) / 9.0)
    knocking[7] = 40.0
    [diagnosis] = made.process(window(made, knocking))
    [rule] = [rule for rule in map(alarm_rule, machine().alarms) if rule.alarm == "knocks"]
    finding = rule.watch().find(diagnosis, Circumstances())
    assert finding is not None
    assert re.fullmatch(said, finding.sentence)


def test_missing_samples_and_silence_hold_the_decision() -> None:
    made = detector()
    knocking = np.sin(np.arange(made.block) / 9.0)
    knocking[7] = 40.0
    [alert] = made.process(window(made, knocking))
    torn = np.where(np.arange(made.block) < made.block // 4, np.nan, 0.0)
    [held] = made.process(window(made, torn, made.block))
    assert (held.decision, held.severity, held.changed) == (alert.decision, alert.severity, False)
    assert (held.quality, held.missing_share) == ("missing", pytest.approx(0.25, abs=0.01))
    [silent] = made.silent(3.0, 5 * 10**9)
    assert (silent.decision, silent.quality, silent.t_ns) == ("alert", "missing", 5 * 10**9)
    [dead] = made.process(window(made, np.zeros(made.block)))
    assert (dead.decision, dead.statistics["crest_factor"]) == ("normal", 0.0)


def two_sensors(folder: Path) -> Path:
    """The motor with a second accelerometer, and a knock in a recording of each of the two by itself."""
    file = folder / "machine.toml"
    sensor = MOTOR.read_text().partition("[[sensors]]")[2].partition("[pipeline]")[0]
    other = "[[sensors]]" + sensor.replace('"accel-de"', '"accel-nde"').replace('"de"', '"nde"')
    text = MOTOR.read_text().replace("samples_per_frame = 30", "samples_per_frame = 15")
    text = text.replace("channels = [", 'channels = [\n  { name = "nde", type = "int16", scale = 0.0005 },')
    file.write_text(f"{text}\n{other}\n{TABLE}\n{ALARM}")
    knocking = np.sin(np.arange(3 * RATE_HZ) / 9.0)
    knocking[RATE_HZ + 7] = 40.0
    for name in ("accel-de", "accel-nde"):
        np.savez(folder / f"{name}.npz", **{name: knocking}, fs=RATE_HZ)
    return file


def test_it_judges_recordings_too(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """`analyze` knows no detector: what it shows of one comes with the plugin."""
    file = two_sensors(tmp_path)
    assert main(["analyze", str(file), str(tmp_path / "accel-de.npz"), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)["detectors"]["crest"]
    assert [step["decision"] for step in found["history"]] == ["normal", "alert", "normal"]
    assert (found["decision"], found["worst"]["onset_sample"]) == ("normal", RATE_HZ)
    assert found["statistics"]["crest_factor"] == pytest.approx(np.sqrt(2), rel=1e-2)
    # The other bearing alone has nothing for it.
    assert main(["analyze", str(file), str(tmp_path / "accel-nde.npz"), "--json"]) == 0
    assert set(json.loads(capsys.readouterr().out)["detectors"]) == {"levels/accel-nde"}


def test_why_it_refuses_a_recording_steers_no_terminal(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    class Refusing(api.RecordedDetector[Any]):
        def evaluate(self, *_: Any) -> Any:
            raise ValueError("it is\n\x1b[2J too short")

    def refusing(_self: Any, machine: MachineFile, given: Any, options: api.RecordingOptions) -> Refusing:
        return Refusing(machine, given, options)

    monkeypatch.setattr(importlib.import_module("crest").CrestPlugin, "recorded", refusing)
    main(["analyze", str(two_sensors(tmp_path)), str(tmp_path / "accel-de.npz")])
    said = "".join(capsys.readouterr())
    assert "too short" in said
    assert all(line.isprintable() for line in said.splitlines())


def test_a_statement_by_hand_that_cannot_be_told_is_refused_in_recordings_too(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def process(self: Any, window: Window) -> list[api.Diagnosis]:
        return [replace(one, statistics={"rms": np.nan}) for one in api.WindowDetector.process(self, window)]

    monkeypatch.setattr(importlib.import_module("crest").CrestDetector, "process", process, raising=False)
    main(["analyze", str(two_sensors(tmp_path)), str(tmp_path / "accel-de.npz")])
    said = "".join(capsys.readouterr())
    assert "it returns a statement that cannot be sent: rms is nan; give a finite number" in said
    assert "Traceback" not in said


def test_it_may_say_what_else_is_shown_of_a_recording(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    crest = importlib.import_module("crest")

    class Shown(api.RecordedDetector[Any]):
        def evaluate(self, recorded: api.Recorded, given: Any, progress: Any) -> api.Evaluated:
            said = api.statements_of(crest.CrestDetector(recorded.machine, given), recorded)
            return api.Evaluated(said, draw=lambda prefix: Path(f"{prefix}-crest.svg").write_text("<svg/>"))

    def shown(_self: Any, machine: MachineFile, given: Any, options: api.RecordingOptions) -> Shown:
        return Shown(machine, given, options)

    monkeypatch.setattr(crest.CrestPlugin, "recorded", shown)
    file = two_sensors(tmp_path)
    assert main(["analyze", str(file), str(tmp_path / "accel-de.npz"), "--plot", str(tmp_path / "out")]) == 0
    assert "crest: normal (normal, alert at 1.000 s)" in capsys.readouterr().out
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["accel-de-crest.svg"]


def test_what_is_wrong_in_its_table_is_said() -> None:
    text = MOTOR.read_text()
    [misspelt] = problems_of(f"{text}\n{TABLE.replace('alert', 'alret')}", MOTOR)
    assert "pipeline.crest.alret = 5.0: unknown key. Remedy: did you mean alert?" in str(misspelt)
    [nobody] = problems_of(f"{text}\n{TABLE.replace('accel-de', 'accel-d')}", MOTOR)
    assert nobody.message == "there is no such sensor"
    assert nobody.remedy.startswith('did you mean "accel-de"?')


def test_the_documentation_shows_the_example_as_it_is() -> None:
    text = (DOCS / "detectors.md").read_text()
    for name in ("crest.py", "pyproject.toml"):
        assert (DETECTOR / name).read_text().strip() in text, f"docs/detectors.md has another {name}"
