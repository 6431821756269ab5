"""What a snapshot holds, kind by kind, and the topic that each has in the file."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal, TypeAlias

if TYPE_CHECKING:
    from collections.abc import Mapping

    from daqsvc.acquisition.samples import SampleBlock

SCHEMA: Literal["daqsvc.snapshot/1"] = "daqsvc.snapshot/1"
"""What the first message of a snapshot states that it is."""
SUFFIX = ".mcap"
"""How its name ends."""

ABOUT = "/about"
SAMPLES = "/samples/"
"""In front of the name of a stream, or of a grid."""
CAUSES = "/causes"
"""Those that came while it was written; the first is in the first message."""
STANDING = "/standing"
WINDOWS = "/windows"
STATES = "/states"
DIAGNOSES = "/diagnoses"
ALARMS = "/alarms"

MACHINE_TOML = "machine.toml"
"""The machine file as it was read."""
MACHINE_JSON = "machine.json"
"""Its values as they were in force, but for those of outputs and store."""
FILES = "files/"
"""In front of the name of a file that the machine file names."""
STORE = "store/"
"""In front of the name of a file of the store that detectors begin with."""

Document: TypeAlias = "dict[str, Any]"


@dataclass(frozen=True, slots=True)
class Noted:
    """Something that happened beside samples.

    Attributes:
        topic: its kind.
        document: what JSON can hold of it.
    """

    topic: str
    document: Document


@dataclass(frozen=True, slots=True)
class Entry:
    """One thing of a snapshot.

    Attributes:
        at_ns: when it came, on the monotonic clock of the box.
        what: samples, or something else.
    """

    at_ns: int
    what: SampleBlock | Noted


@dataclass(frozen=True, slots=True)
class Snapshot:
    """A snapshot that was read.

    Attributes:
        about: its first message, with the causes that came later among its ``causes``.
        files: by name, the files in it.
        entries: what happened, in order.
        notes: what is wrong with the file, in sentences.
    """

    about: Document
    files: Mapping[str, bytes]
    entries: list[Entry] = field(default_factory=list)
    notes: tuple[str, ...] = ()
