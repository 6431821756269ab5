"""A snapshot is written entry by entry, so that whatever was written can be read at any time."""

from __future__ import annotations

import contextlib
import errno
import json
import os
from typing import TYPE_CHECKING, Any, BinaryIO

from google.protobuf.descriptor_pb2 import FieldDescriptorProto, FileDescriptorProto, FileDescriptorSet
from pydantic_core import to_json

from daqsvc import __version__
from daqsvc.acquisition.samples import SampleBlock
from daqsvc.snapshots import samples_pb2
from daqsvc.snapshots.contents import (
    ABOUT,
    ALARMS,
    CAUSES,
    DIAGNOSES,
    SAMPLES,
    STANDING,
    STATES,
    WINDOWS,
)
from daqsvc.snapshots.mcap import McapWriter, Schema

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping
    from pathlib import Path

    from daqsvc.snapshots.contents import Entry
    from daqsvc.snapshots.mcap import Mark

CHUNK_BYTES = 1 << 18
"""A cut takes no more than the chunk that it is in."""
FLAGS = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC
MODE = 0o640
"""Samples and machine files are for the service and its group."""
MEDIA_TYPES = {".toml": "application/toml", ".json": "application/json"}


class SnapshotWriter:
    """Writes one file; every method blocks, and may be called from one thread at a time.

    Args:
        path: of the file, which must not exist.
        about: see `Snapshot.about`; ``streams`` are those that may come.
        files: by name, files that go with it.
        wall_ns: wall time at 0 of the monotonic clock, ns since the Unix epoch.

    Raises:
        OSError: it cannot be written.
    """

    def __init__(
        self, path: Path, about: Mapping[str, Any], files: Mapping[str, bytes], wall_ns: int
    ) -> None:
        self.path = path
        self._wall_ns = wall_ns
        self._file: BinaryIO = os.fdopen(os.open(path, FLAGS, MODE), "wb")
        self._taken: Mark | None = None
        """How far the operating system has taken it whole."""
        try:
            self._mcap = McapWriter(self._file, f"daqsvc {__version__}")
            for topic in (ABOUT, CAUSES, ALARMS, DIAGNOSES, STANDING, WINDOWS, STATES):
                self._mcap.open_channel(topic, "json", _JSON, {})
            samples = samples_schema()
            for stream, facts in about["streams"].items():
                metadata = {key: json.dumps(value) for key, value in facts.items()}
                self._mcap.open_channel(f"{SAMPLES}{stream}", "protobuf", samples, metadata)
            self._note(ABOUT, int(about["begin_ns"]), about)
            self._mcap.flush()
            for name, data in files.items():
                media_type = MEDIA_TYPES.get(f".{name.rpartition('.')[2]}", "application/octet-stream")
                self._mcap.attach(name, media_type, data, self._wall(int(about["begin_ns"])))
        except BaseException:
            self._file.close()
            raise

    @property
    def size(self) -> int:
        """Bytes of the file."""
        return self._mcap.size

    def write(self, entries: Iterable[Entry]) -> None:
        """Write what has happened, as far as into the hands of the operating system.

        Raises:
            OSError: it cannot be written.
        """
        for entry in entries:
            if isinstance(entry.what, SampleBlock):
                self._block(entry.at_ns, entry.what)
            else:
                self._note(entry.what.topic, entry.at_ns, entry.what.document)
            if self._mcap.waiting_bytes >= CHUNK_BYTES:
                self._mcap.flush()
        self._mcap.flush()
        self._file.flush()
        self._taken = self._mcap.mark()

    def finish(self) -> None:
        """Write the end, and have all of it on disk.

        Raises:
            OSError: it cannot be written.
        """
        try:
            self._mcap.finish()
            self._file.flush()
            os.fsync(self._file.fileno())
        finally:
            self._file.close()

    def finish_what_was_taken(self) -> None:
        """After an error: end the file behind the last that was written whole, as if nothing had followed.

        Raises:
            OSError: it cannot be written.
        """
        with contextlib.suppress(OSError):
            self._file.close()
        if self._taken is None:
            raise OSError(errno.EIO, "nothing of it was written", f"{self.path}")
        self._file = self.path.open("r+b")
        try:
            self._file.truncate(self._taken.size)
            self._file.seek(0, os.SEEK_END)
            self._mcap.go_back(self._taken, self._file)
        except BaseException:
            self._file.close()
            raise
        self.finish()

    def abandon(self) -> None:
        """Leave the file as it is: what was written can be read."""
        self._file.close()

    def _wall(self, at_ns: int) -> int:
        return max(at_ns + self._wall_ns, 0)

    def _note(self, topic: str, at_ns: int, document: Mapping[str, Any]) -> None:
        # Others read this as well, and no other JSON than the standard's.
        data = to_json({"at_ns": at_ns, **document}, inf_nan_mode="null")
        self._mcap.write(topic, self._wall(at_ns), self._wall(at_ns), data)

    def _block(self, at_ns: int, block: SampleBlock) -> None:
        message = samples_pb2.SampleBlock(
            at_ns=at_ns,
            first_index=block.first_index,
            t_first_ns=block.t_first_ns,
            period_ns=block.period_ns,
            lost_before=block.lost_before,
            quality=int(block.quality),
            t_error_ns=block.t_error_ns,
            pause_before=block.pause_before,
            channels=block.samples.shape[1],
            samples=block.samples.astype("<f4", copy=False).tobytes(),
        )
        topic = f"{SAMPLES}{block.stream}"
        self._mcap.write(topic, self._wall(at_ns), self._wall(block.t_first_ns), message.SerializeToString())


_JSON = Schema("daqsvc.Noted", "jsonschema", b'{"type": "object"}')


def samples_schema() -> Schema:
    """The schema of samples as other tools are to see them: numbers, where this program sees their bytes."""
    file = FileDescriptorProto()
    samples_pb2.DESCRIPTOR.CopyToProto(file)
    declared: Any = file.message_type[0].field
    for one in declared:
        if one.name == "samples":
            one.type = FieldDescriptorProto.TYPE_FLOAT
            one.label = FieldDescriptorProto.LABEL_REPEATED
            one.options.packed = True
    return Schema(
        "daqsvc.SampleBlock", "protobuf", FileDescriptorSet(file=[file]).SerializeToString(deterministic=True)
    )
