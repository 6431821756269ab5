"""What authors of drivers and detectors import; nothing else of daqsvc is public.

A package registers a `DriverPlugin` in the group of entry points ``daqsvc.drivers`` under the name that
``driver = "..."`` of a bus gives, or a `DetectorPlugin` in ``daqsvc.detectors`` under the key of its table in
``[pipeline]``. ``docs/drivers.md`` and ``docs/detectors.md`` show one of each. Names leave this module only
with a new major version.
"""

from daqsvc.acquisition.assembler import StreamAssembler
from daqsvc.acquisition.clock import Clock
from daqsvc.acquisition.link import Link
from daqsvc.acquisition.samples import SampleBlock
from daqsvc.diagnosis.detector import Detector, Window
from daqsvc.diagnosis.plugin import DetectorPlugin
from daqsvc.diagnosis.reading import Reading
from daqsvc.diagnosis.record import Diagnosis
from daqsvc.diagnosis.window_detector import Judgement, WindowDetector
from daqsvc.settings.buses import Bus, Layout
from daqsvc.settings.models import MachineFile, Sensor, Stream
from daqsvc.settings.packing import PackedLayout
from daqsvc.settings.plugins import StreamWords
from daqsvc.settings.problems import AssemblyError, Finding, choice
from daqsvc.settings.section import Name, Section, Text
from drivers.base import BusCounters, BusPort, Driver, StreamSpec
from drivers.frames import FrameLayout, LayoutError
from drivers.plugin import DriverPlugin
from drivers.reconnect import Attempt, CannotOpenError, in_thread, run_with_reconnect
from drivers.stream_driver import StreamDriver, assembler_of

__all__ = [
    "AssemblyError",
    "Attempt",
    "Bus",
    "BusCounters",
    "BusPort",
    "CannotOpenError",
    "Clock",
    "Detector",
    "DetectorPlugin",
    "Diagnosis",
    "Driver",
    "DriverPlugin",
    "Finding",
    "FrameLayout",
    "Judgement",
    "Layout",
    "LayoutError",
    "Link",
    "MachineFile",
    "Name",
    "PackedLayout",
    "Reading",
    "SampleBlock",
    "Section",
    "Sensor",
    "Stream",
    "StreamAssembler",
    "StreamDriver",
    "StreamSpec",
    "StreamWords",
    "Text",
    "Window",
    "WindowDetector",
    "assembler_of",
    "choice",
    "in_thread",
    "run_with_reconnect",
]
