"""A snapshot is read, in a separate process: it may be cut, damaged, or made to do harm.

`load` is what that process does, `read_snapshot` what calls it.
"""

from __future__ import annotations

import base64
import json
import math
import stat
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from google.protobuf.message import DecodeError

from daqsvc.acquisition.samples import Quality, SampleBlock
from daqsvc.confined.process import ConfinedError, ConfinedProcess, RaisedThereError
from daqsvc.errors.recordings import SNAPSHOT
from daqsvc.snapshots import samples_pb2
from daqsvc.snapshots.contents import ABOUT, CAUSES, SAMPLES, SCHEMA, Entry, Noted, Snapshot
from daqsvc.snapshots.mcap import Attachment, Damage, McapError, Message, read

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    from daqsvc.confined.limits import ResourceLimits
    from daqsvc.snapshots.contents import Document

WAS_CUT = "was cut before any sample was written in it; copy it again, or give another one"
"""What is reported behind a snapshot of which only the begin is there."""
_REMEDY = "it may be damaged: copy it again, or give another one"


class SnapshotError(Exception):
    """A snapshot that cannot be read; states the file, the reason and the remedy."""

    code = SNAPSHOT


def entries_of(data: memoryview, damage: Damage) -> Iterator[Entry | Attachment]:
    """What a file holds, in order, its first message included.

    Args:
        data: the file.
        damage: takes in what is wrong with it.

    Raises:
        McapError: it is no snapshot.
    """
    for one in read(data, damage):
        yield one if isinstance(one, Attachment) else _entry(one)


def _entry(message: Message) -> Entry:
    if message.topic.startswith(SAMPLES):
        return _block(message.topic.removeprefix(SAMPLES), message.data)
    try:
        document = json.loads(bytes(message.data))
        at_ns = int(document.pop("at_ns"))
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError):
        raise McapError(f"holds a message on {message.topic} that is none of daqsvc's") from None
    return Entry(at_ns, Noted(message.topic, document))


def _block(stream: str, data: bytes | memoryview) -> Entry:
    try:
        message = samples_pb2.SampleBlock.FromString(bytes(data))
        channels = message.channels if math.isfinite(message.period_ns) else 0
        # No array has rows of no values, so that such a message is refused with the others.
        samples = np.frombuffer(message.samples, "<f4").reshape(-1, channels).astype(np.float32)
        block = SampleBlock(
            stream,
            message.first_index,
            samples,
            message.t_first_ns,
            message.period_ns,
            message.lost_before,
            Quality(message.quality),
            message.t_error_ns,
            message.pause_before if message.HasField("pause_before") else None,
        )
    except (DecodeError, ValueError, OverflowError):
        raise McapError(f"holds samples of {stream!r:.60} that are none of daqsvc's") from None
    return Entry(message.at_ns, block)


def load(path: str) -> tuple[Document, list[NDArray[np.float32]]]:
    """Read a snapshot; called in a separate process.

    Returns:
        ``about``, ``files`` in base64, ``notes`` and ``entries``: of a block all but its samples, which are
        the next rows of its stream's array, by ``streams``. And these arrays.

    Raises:
        SnapshotError: it is none.
    """
    damage = Damage()
    about: Document | None = None
    files: dict[str, str] = {}
    entries: list[list[Any]] = []
    rows: dict[str, list[NDArray[np.float32]]] = {}
    try:
        data = Path(path).read_bytes()
        for one in entries_of(memoryview(data), damage):
            if isinstance(one, Attachment):
                files[one.name] = base64.b64encode(one.data).decode()
            elif isinstance(one.what, SampleBlock):
                block = one.what
                rows.setdefault(block.stream, []).append(block.samples)
                entries.append([one.at_ns, block.stream, len(block.samples), *_facts(block)])
            elif one.what.topic == ABOUT:
                about = about or {"begin_ns": one.at_ns, **one.what.document}
            else:
                entries.append([one.at_ns, one.what.topic, one.what.document])
        arrays = [np.concatenate(blocks) for blocks in rows.values()]
    except OSError as error:
        raise SnapshotError(f"{path} cannot be read: {error.strerror or error}; correct the path") from None
    except (McapError, ValueError) as error:
        raise SnapshotError(f"{path} cannot be read: it {error}; {_REMEDY}") from None
    if damage.ends_early and not rows:
        raise SnapshotError(f"{path} {WAS_CUT}")
    if about is None or about.get("schema") != SCHEMA or not isinstance(about.get("streams"), dict):
        raise SnapshotError(
            f"{path} is no snapshot of daqsvc, or one of another version: its first message is not {SCHEMA}"
        )
    return {
        "about": {**about, "causes": _causes(about, entries)} if "causes" in about else about,
        "files": files,
        "entries": entries,
        "streams": list(rows),
        "notes": notes_of(damage),
    }, arrays


def _causes(about: Document, entries: list[list[Any]]) -> list[str]:
    """Why a snapshot was made, in words: what it begins with, and what came while it was written."""
    first = about["causes"]
    later = [one[2].get("cause") for one in entries if one[1] == CAUSES and isinstance(one[2], dict)]
    return [one for one in (*(first if isinstance(first, list) else ()), *later) if isinstance(one, str)]


def _facts(block: SampleBlock) -> list[Any]:
    error_ns = None if not math.isfinite(block.t_error_ns) else block.t_error_ns
    return [
        block.first_index,
        block.t_first_ns,
        block.period_ns,
        block.lost_before,
        int(block.quality),
        error_ns,
        block.pause_before,
    ]


def notes_of(damage: Damage) -> list[str]:
    """What is wrong with a file, in sentences."""
    notes = []
    if damage.ends_early:
        notes.append("the snapshot ends early: it was cut, or is still being written")
    if damage.damaged_chunks:
        count = damage.damaged_chunks
        parts = "1 part of the snapshot is" if count == 1 else f"{count:,} parts of the snapshot are"
        notes.append(f"{parts} damaged and left out")
    return notes


def read_snapshot(path: Path, limits: ResourceLimits, process: ConfinedProcess | None = None) -> Snapshot:
    """Read a snapshot, in a separate process.

    Args:
        path: the file.
        limits: what reading it may take.
        process: reads it; None for one that ends with this.

    Raises:
        SnapshotError: it cannot be read, or is none.
    """
    try:
        status = path.stat()
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise SnapshotError(f"{path!s:.200} cannot be read: {reason}; correct the path") from None
    if not stat.S_ISREG(status.st_mode):
        raise SnapshotError(f"{path} cannot be read: it is no file but a folder, pipe or device; give a file")
    reader = process or ConfinedProcess()
    try:
        document, arrays = reader.call(
            f"{__name__}:load",
            {"path": str(path)},
            memory_bytes=limits.memory_bytes,
            cpu_s=limits.cpu_s(status.st_size),
        )
    except RaisedThereError as error:
        if error.kind == SnapshotError.__name__:
            raise SnapshotError(error.message) from None
        raise SnapshotError(f"{path} cannot be read: {error}; {_REMEDY}") from None
    except ConfinedError as error:
        raise SnapshotError(f"{path} cannot be read: {error.how}; {_REMEDY}") from None
    finally:
        if process is None:
            reader.close()
    return _assembled(document, dict(zip(document["streams"], arrays, strict=True)))


def _assembled(document: Document, samples: dict[str, NDArray[np.float32]]) -> Snapshot:
    taken = dict.fromkeys(samples, 0)
    entries: list[Entry] = []
    for at_ns, name, *rest in document["entries"]:
        if name not in taken or isinstance(rest[0], dict):
            entries.append(Entry(at_ns, Noted(name, rest[0])))
            continue
        count, first_index, t_first_ns, period_ns, lost, quality, error_ns, pause = rest
        begin, taken[name] = taken[name], taken[name] + count
        entries.append(
            Entry(
                at_ns,
                SampleBlock(
                    name,
                    first_index,
                    samples[name][begin : begin + count],
                    t_first_ns,
                    period_ns,
                    lost,
                    Quality(quality),
                    math.inf if error_ns is None else error_ns,
                    pause,
                ),
            )
        )
    files = {name: base64.b64decode(text) for name, text in document["files"].items()}
    return Snapshot(document["about"], files, entries, tuple(document["notes"]))
