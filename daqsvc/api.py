"""What authors of drivers, detectors and outputs import; nothing else of daqsvc is public.

A package registers a `DriverPlugin` in the group of entry points ``daqsvc.drivers`` under the name that
``driver = "..."`` of a bus gives, a `DetectorPlugin` in ``daqsvc.detectors`` under the key of its table in
``[pipeline]``, or an `OutputPlugin` in ``daqsvc.outputs`` under the path of its table. Codes of its
messages are each a `PluginCode` in a module that it registers in ``daqsvc.codes`` under their letters.
``docs/write-a-driver.md``, ``docs/detectors.md`` and ``docs/outputs.md`` show one of each. Names leave
this module only with a new major version.
"""

from daqsvc.acquisition.assembler import StreamAssembler
from daqsvc.acquisition.clock import Clock
from daqsvc.acquisition.link import Link
from daqsvc.acquisition.samples import SampleBlock
from daqsvc.alarms.conditions import Condition
from daqsvc.alarms.states import Level
from daqsvc.diagnosis.detector import Detector, Window
from daqsvc.diagnosis.plugin import Detectability, DetectabilityOptions, DetectorPlugin, UnfitOptionError
from daqsvc.diagnosis.reading import Reading
from daqsvc.diagnosis.record import Diagnosis, Severity
from daqsvc.diagnosis.recorded import Evaluated, Recorded, RecordedDetector, RecordingOptions, statements_of
from daqsvc.diagnosis.window_detector import Judgement, WindowDetector
from daqsvc.errors.code import PluginCode, coded
from daqsvc.notice import notice
from daqsvc.outbox.messages import OutboxMessage
from daqsvc.publish.output import Output, OutputPort, Watched
from daqsvc.publish.plugin import OutputPlugin
from daqsvc.settings.buses import Bus, Device, Layout
from daqsvc.settings.models import MachineFile, Sensor, Stream
from daqsvc.settings.packing import PackedLayout
from daqsvc.settings.plugins import StreamWords
from daqsvc.settings.problems import AssemblyError, Finding, choice
from daqsvc.settings.section import Name, Section, Text
from drivers import questions, toml_lines
from drivers.base import BusCounters, BusOptionError, BusPort, DeviceAbsentError, Driver, StreamSpec
from drivers.bus_questions import BusQuestions, Heard
from drivers.frames import FrameLayout, LayoutError
from drivers.plugin import DriverPlugin
from drivers.questions import Question, Topic
from drivers.reconnect import Attempt, CannotOpenError, in_thread, run_with_reconnect
from drivers.sniffing import Sniffed, Sniffer, SniffError, SniffTable
from drivers.stream_driver import StreamDriver, assembler_of

__all__ = [
    "AssemblyError",
    "Attempt",
    "Bus",
    "BusCounters",
    "BusOptionError",
    "BusPort",
    "BusQuestions",
    "CannotOpenError",
    "Clock",
    "Condition",
    "Detectability",
    "DetectabilityOptions",
    "Detector",
    "DetectorPlugin",
    "Device",
    "DeviceAbsentError",
    "Diagnosis",
    "Driver",
    "DriverPlugin",
    "Evaluated",
    "Finding",
    "FrameLayout",
    "Heard",
    "Judgement",
    "Layout",
    "LayoutError",
    "Level",
    "Link",
    "MachineFile",
    "Name",
    "OutboxMessage",
    "Output",
    "OutputPlugin",
    "OutputPort",
    "PackedLayout",
    "PluginCode",
    "Question",
    "Reading",
    "Recorded",
    "RecordedDetector",
    "RecordingOptions",
    "SampleBlock",
    "Section",
    "Sensor",
    "Severity",
    "SniffError",
    "SniffTable",
    "Sniffed",
    "Sniffer",
    "Stream",
    "StreamAssembler",
    "StreamDriver",
    "StreamSpec",
    "StreamWords",
    "Text",
    "Topic",
    "UnfitOptionError",
    "Watched",
    "Window",
    "WindowDetector",
    "assembler_of",
    "choice",
    "coded",
    "in_thread",
    "notice",
    "questions",
    "run_with_reconnect",
    "statements_of",
    "toml_lines",
]
