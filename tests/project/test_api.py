"""What is public: its names stay, each is documented, and nothing else has to be imported."""

from __future__ import annotations

import inspect

from daqsvc import api

NAMES = {
    *("Driver", "DriverPlugin", "StreamDriver", "BusPort", "BusCounters", "StreamSpec", "Link", "Clock"),
    *("StreamAssembler", "assembler_of", "SampleBlock", "FrameLayout", "LayoutError"),
    *("Device", "DeviceAbsentError", "BusOptionError", "Severity"),
    *("BusQuestions", "Heard", "Question", "Topic", "questions", "toml_lines"),
    *("Sniffer", "Sniffed", "SniffTable", "SniffError"),
    *("Attempt", "CannotOpenError", "in_thread", "run_with_reconnect"),
    *("Detector", "DetectorPlugin", "WindowDetector", "Judgement", "Window", "Diagnosis", "Reading"),
    *("Output", "OutputPlugin", "OutputPort", "OutboxMessage", "Watched", "Condition", "Level"),
    *("MachineFile", "Section", "Bus", "Layout", "PackedLayout", "Stream", "Sensor", "Name", "Text"),
    *("RecordedDetector", "Recorded", "RecordingOptions", "Evaluated", "statements_of"),
    *("Detectability", "DetectabilityOptions", "UnfitOptionError"),
    *("AssemblyError", "Finding", "StreamWords", "choice", "PluginCode", "coded", "notice"),
}
TYPE_ALIASES = {"Name", "Text", "Sensor", "Severity"}


def test_the_names_are_these() -> None:
    assert set(api.__all__) == NAMES
    assert len(api.__all__) == len(NAMES)


def test_each_is_documented() -> None:
    bare = [name for name in NAMES - TYPE_ALIASES if not inspect.getdoc(getattr(api, name))]
    assert bare == []


def test_nothing_else_is_in_it() -> None:
    more = {name for name in vars(api) if not name.startswith("_")} - NAMES
    assert more == set()
