"""The machine file: its models, reading it with every problem named, and stating what was understood."""

from daqsvc.settings.describe import describe
from daqsvc.settings.load import load_machine_file, parse_machine_file
from daqsvc.settings.models import MachineFile
from daqsvc.settings.problems import MachineFileError, Problem

__all__ = [
    "MachineFile",
    "MachineFileError",
    "Problem",
    "describe",
    "load_machine_file",
    "parse_machine_file",
]
