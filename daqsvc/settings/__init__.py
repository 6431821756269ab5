"""The machine file: its models, reading it with every problem named, and saying what was understood."""

from daqsvc.settings.models import MachineFile
from daqsvc.settings.problems import MachineFileError, Problem

__all__ = ["MachineFile", "MachineFileError", "Problem"]
