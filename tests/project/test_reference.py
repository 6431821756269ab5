"""The reference is made from the code, current, and leaves out nothing that users see."""

from __future__ import annotations

import re
import tomllib
from typing import TYPE_CHECKING

import pytest
from support.paths import ROOT

from daqsvc.alarm_commands import CommandCounters
from daqsvc.commands.status import StatusCommand
from daqsvc.publish.home_assistant.discovery import Discovery
from daqsvc.publish.payloads import AlarmPayload
from daqsvc.publish.sparkplug.host import STATES
from daqsvc.publish.sparkplug.node import NAMESPACE
from daqsvc.publish.topics import Topics
from daqsvc.reference import alarms, counters, figures, keys, messages, metrics, pages, process, verbs
from daqsvc.reference.__main__ import main
from daqsvc.reference.markdown import toml
from daqsvc.settings.recorder import Recorder

if TYPE_CHECKING:
    import argparse

pytestmark = pytest.mark.unit
DOCS = ROOT / "docs" / "reference"
REMEDY = "make reference (python -m daqsvc.reference docs/reference)"
SPECIMENS = sorted((ROOT / "tests" / "guard" / "specimens").rglob("*.toml"))
SOURCES = [file for room in ("daqsvc", "drivers", "sim_hw") for file in (ROOT / room).rglob("*.py")]


@pytest.fixture(scope="module")
def made():
    return pages.pages(DOCS)


def test_the_committed_pages_are_those_of_the_code(made):
    for name, text in made.items():
        assert (DOCS / name).read_text(encoding="utf-8") == text, f"docs/reference/{name}: {REMEDY}"


def test_nothing_lacks_words():
    assert pages.gaps() == []


def test_options_that_help_does_not_show_are_not_there(made):
    assert "SUPPRESS" not in made["verbs.md"]


def test_options_of_daqsvc_itself_are_listed(made):
    assert '<a id="daqsvc--version"></a>`--version`' in made["verbs.md"]


def test_no_page_has_two_anchors_of_one_name(made):
    for name, text in made.items():
        anchors = re.findall(r'<a id="([^"]+)">', text)
        assert len(anchors) == len(set(anchors)), name


def paths(table, path=""):
    """The paths of all keys of a machine file, as the reference names them."""
    for key, value in table.items():
        here = f"{path}.{key}" if path else key
        below = "buses" if path == "buses" else "streams" if path == "streams" else ""
        if below:
            here = f"{below}.NAME"
        else:
            yield here
        if isinstance(value, dict) and not here.endswith(".options"):
            yield from paths(value, here)
        elif isinstance(value, list):
            for item in value:
                if isinstance(item, dict):
                    yield from paths(item, f"{here}[]")


@pytest.mark.parametrize("file", SPECIMENS, ids=lambda file: file.name)
def test_every_key_of_a_file_that_has_all_is_found_by_its_name(made, file):
    text = "".join(page for name, page in made.items() if name.startswith("keys"))
    for path in paths(tomllib.loads(file.read_text(encoding="utf-8"))):
        # Tables of the top level have pages of their own.
        assert f"`{path}`" in text or f"(keys-{path.replace('_', '-')}.md)" in text, path


def test_every_example_is_toml_and_valid():
    """A file that has it is refused for other reasons only, and only by what the key belongs to."""
    for held in keys.tables().values():
        for variants in held.keys.values():
            for one in variants:
                if one.example:
                    assert one.name in tomllib.loads(one.example.strip("`").replace(", ...", "")), one


@pytest.mark.parametrize("value", [True, 2.0, 12, "text\n", [1.5, -2], {"a": [1]}, 1_000_000, 1e300])
def test_a_value_is_written_as_toml(value):
    assert tomllib.loads(f"value = {toml(value)}") == {"value": value}


def gaps_of(maker):
    return "; ".join(maker.gaps())


def test_a_key_without_a_description_is_a_gap(monkeypatch):
    monkeypatch.setattr(Recorder.model_fields["before_s"], "description", None)
    assert "recorder.before_s (daqsvc.settings.recorder.Recorder) has no description" in gaps_of(keys)


def test_a_key_without_an_example_is_a_gap(monkeypatch):
    monkeypatch.setattr(Recorder.model_fields["every_s"], "examples", None)
    assert "recorder.every_s (daqsvc.settings.recorder.Recorder) has neither an example" in gaps_of(keys)


def test_a_verb_or_an_option_without_help_is_a_gap(monkeypatch):
    def with_bare_option(_self: StatusCommand, parser: argparse.ArgumentParser) -> None:
        parser.add_argument("--bare")

    monkeypatch.setattr(StatusCommand, "add_arguments", with_bare_option)
    monkeypatch.setattr(StatusCommand, "description", "")
    found = gaps_of(verbs)
    assert "daqsvc status --bare BARE has no help" in found
    assert "daqsvc status has no description" in found


def test_a_counter_that_nothing_describes_is_a_gap(monkeypatch):
    words = {path: text for path, text in counters.WORDS.items() if path != "page.starts"}
    monkeypatch.setattr(counters, "WORDS", words)
    monkeypatch.setattr(CommandCounters, "__doc__", "Nothing is said of its attributes.")
    found = gaps_of(counters)
    assert "figure page.starts of the status is described nowhere" in found
    assert "figure commands.accepted of the status is described nowhere" in found


def test_a_metric_without_help_is_a_gap(monkeypatch):
    real = metrics.health_metric

    def without_help(machine, *, is_healthy):
        metric = real(machine, is_healthy=is_healthy)
        metric.documentation = ""
        return metric

    monkeypatch.setattr(metrics, "health_metric", without_help)
    assert gaps_of(metrics).startswith("metric daqsvc_healthy has no help text")


def test_metrics_of_the_process_are_listed_with_its_own(made):
    for name in ("process_open_fds", "process_resident_memory_bytes", "process_cpu_seconds_total"):
        assert f'<a id="{name}"></a>' in made["metrics.md"]


def test_every_topic_of_home_assistant_and_sparkplug_is_listed(made):
    """What their sources name, and what a run has published that has both of them."""
    listed = {name: one.topic for name, one in messages.other_topics().items()}
    sources = "".join(file.read_text("utf-8") for file in (ROOT / "daqsvc/publish/sparkplug").glob("*.py"))
    kinds = set(re.findall(r'"([ND](?:BIRTH|DEATH|DATA|CMD))"', sources))
    assert len(kinds) == 8
    assert kinds < set(listed)
    assert {f"{NAMESPACE}/STATE/HOST", "STATE/HOST"} == {f"{begin}HOST" for begin in STATES}
    assert {f"{begin}HOST" for begin in STATES} <= {*listed.values()}
    assert {name for name in dir(Discovery) if name.endswith("topic")} == {"topic", "birth_topic"}
    known = [*listed.values(), *(one.topic for one in messages.topics().values())]
    # A name of an alarm or a detector, which is the last one, may hold a `/`.
    patterns = [
        re.sub(r"(?!STATE|[ND](?:BIRTH|DEATH|DATA|CMD))\b[A-Z]+\b", "[^/]+", one) + "(/.+)?" for one in known
    ]
    golden = (ROOT / "tests/guard/golden/messages.txt").read_text("utf-8")
    published = set(re.findall(r"\b(?:homeassistant|spBv1\.0|daqsvc)/(?!\d)[\w./-]+", golden))
    assert {topic.partition("/")[0] for topic in published} == {"homeassistant", "spBv1.0", "daqsvc"}
    assert [one for one in published if not any(re.fullmatch(pattern, one) for pattern in patterns)] == []
    assert all(f"`{one}`" in made["topics.md"] for one in known)


def test_a_figure_of_a_detector_that_nothing_describes_is_a_gap(monkeypatch, made):
    assert '<a id="figure-rotor-synchronous.departure.energy"></a>`departure.energy`' in made["payloads.md"]
    listed = {
        detector: {name: one for name, one in held.items() if not name.endswith((".energy", "PART.z", "rms"))}
        for detector, held in figures.FIGURES.items()
    }
    listed[figures.ROTOR_BANK]["weight"] = figures.Figure("kg", "made nowhere")
    del listed[figures.ROTOR_BANK]["paper.MODE"], listed[figures.ROTOR_SYNCHRONOUS]["FAULT.of_sag"]
    monkeypatch.setattr(figures, "FIGURES", listed)
    found = gaps_of(messages)
    for name in ("departure.energy", "*.*.z", "rms", "velocity_rms", "paper.*", "*.of_sag"):
        assert f"figure {name} of " in found
    assert "figure weight of rotor-bank is made nowhere" in found


def test_a_topic_or_a_field_that_nothing_describes_is_a_gap(monkeypatch):
    monkeypatch.setattr(Topics, "weather", "daqsvc/weather", raising=False)
    monkeypatch.setattr(AlarmPayload.model_fields["message"], "description", None)
    words = {name: text for name, text in messages.SPARKPLUG_WORDS.items() if name != "DETECTOR/Quality"}
    monkeypatch.setattr(messages, "SPARKPLUG_WORDS", words)
    AlarmPayload.model_rebuild(force=True)
    found = gaps_of(messages)
    monkeypatch.undo()
    AlarmPayload.model_rebuild(force=True)
    assert "topic weather of Topics is described nowhere" in found
    assert "field message of daqsvc.alarm/1 has no description" in found
    assert "Sparkplug metric DETECTOR/Quality is described nowhere" in found


def test_an_exit_code_that_nothing_describes_is_a_gap(monkeypatch):
    monkeypatch.setattr(process.arguments, "EXIT_TIRED", 6, raising=False)
    assert "exit code EXIT_TIRED is described nowhere" in gaps_of(process)


def test_an_alarm_or_a_state_that_nothing_describes_is_a_gap(monkeypatch):
    monkeypatch.setattr(alarms, "STORE", ("store/fire",))
    monkeypatch.setattr(alarms, "STATES", {})
    assert "alarm store/fire is described nowhere" in gaps_of(alarms)
    assert "state normal is described nowhere" in gaps_of(alarms)


@pytest.mark.sources
def test_every_environment_variable_that_is_read_is_there():
    """But for those that are set for processes of ours."""
    read = set()
    for file in SOURCES:
        for line in file.read_text(encoding="utf-8").splitlines():
            if "environ" in line:
                read |= set(re.findall(r'"([A-Z][A-Z0-9_]{2,})"', line))
    assert read - {"HDF5_PLUGIN_PRELOAD"} <= process.ENVIRONMENT.keys()
    assert {"STATE_DIRECTORY", "JOURNAL_STREAM"} <= read


@pytest.mark.sources
def test_every_signal_that_the_program_handles_is_there():
    handled = set()
    for file in (ROOT / "daqsvc" / "commands").rglob("*.py"):
        handled |= set(re.findall(r"signal\.(SIG[A-Z0-9]{3,})", file.read_text(encoding="utf-8")))
    assert handled - {"SIG_DFL", "SIG_IGN"} == set(process.SIGNALS)


def test_gaps_are_said_and_nothing_is_written(monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(Recorder.model_fields["before_s"], "description", None)
    assert main([f"{tmp_path}"]) == 1
    assert "recorder.before_s" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_pages_of_others_are_kept_and_listed_and_old_ones_of_ours_go(made, tmp_path):
    (tmp_path / "errors.md").write_text("# Errors and their codes\n", encoding="utf-8")
    (tmp_path / "keys-gone.md").write_text(made["keys.md"], encoding="utf-8")
    assert main([f"{tmp_path}"]) == 0
    assert {file.name for file in tmp_path.iterdir()} == {*made, "errors.md"}
    assert "- [Errors and their codes](errors.md)" in (tmp_path / "README.md").read_text(encoding="utf-8")
