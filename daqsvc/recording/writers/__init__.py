"""Writers of recordings in the formats of other tools, a module each; the suffix states which it is."""

from __future__ import annotations

import importlib.util
import os
import shutil
import tempfile
from contextlib import contextmanager
from dataclasses import dataclass
from difflib import get_close_matches
from pathlib import Path
from typing import TYPE_CHECKING

from daqsvc.errors.command_line import CANNOT_WRITE, EXTRA_MISSING, THERE_ALREADY, WRONG_VALUE
from daqsvc.errors.recordings import NOT_HELD
from daqsvc.recording import RecordingError
from daqsvc.recording.streams import unique
from daqsvc.recording.writers.delimited import write_csv
from daqsvc.recording.writers.matlab import write_mat
from daqsvc.recording.writers.mdf import write_mdf
from daqsvc.recording.writers.parquet import write_parquet
from daqsvc.recording.writers.uff import write_uff
from daqsvc.recording.writers.wav import write_wav

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence

    from daqsvc.errors.code import Code
    from daqsvc.recording.streams import RecordedStream

LONGEST_PART = 120
"""Bytes of a stream's name in that of a file."""
LONGEST_REASON = 300


class ExportUsageError(Exception):
    """Nothing can be written there, or not in this format; states why, and what to do."""

    def __init__(self, message: str, code: Code) -> None:
        super().__init__(message)
        self.code = code


@dataclass(frozen=True, slots=True)
class Writer:
    """How a format is written.

    Attributes:
        write: writes streams to a file that does not exist yet, with what is stated about all of them;
            returns what the file cannot hold, in sentences.
        several: whether a file holds several streams; else it is called with one.
        library: the module that it needs beside what every installation has; empty if none.
        extra: what brings that.
    """

    write: Callable[[Path, Sequence[RecordedStream], Mapping[str, str]], list[str]]
    several: bool = False
    library: str = ""
    extra: str = ""


WRITERS: Mapping[str, Writer] = {
    ".parquet": Writer(write_parquet, library="pyarrow", extra="parquet"),
    ".csv": Writer(write_csv),
    ".wav": Writer(write_wav),
    ".mat": Writer(write_mat, several=True),
    ".uff": Writer(write_uff, several=True, library="pyuff", extra="uff"),
    ".mf4": Writer(write_mdf, several=True, library="asammdf", extra="mf4"),
}


def writer_of(target: Path) -> Writer:
    """What writes a file, by its suffix.

    Raises:
        ExportUsageError: there is no such format, or the library that writes it is not installed.
    """
    suffix = target.suffix.lower()
    writer = WRITERS.get(suffix)
    if writer is None:
        close = get_close_matches(suffix, WRITERS, n=1)
        meant = f"did you mean {close[0]}? There are" if close else "take one of"
        ends = f"ends in {target.suffix}" if suffix else "has no suffix"
        raise ExportUsageError(
            f"{target} {ends}, which selects no format: {meant} {', '.join(WRITERS)}", WRONG_VALUE
        )
    if writer.library and importlib.util.find_spec(writer.library) is None:
        raise ExportUsageError(
            f"{suffix} files need {writer.library}; install it with: pip install 'daqsvc[{writer.extra}]'",
            EXTRA_MISSING,
        )
    return writer


def targets_of(target: Path, streams: Sequence[RecordedStream]) -> dict[Path, Sequence[RecordedStream]]:
    """The files that are written, with the streams in each: where a file holds one only, a file for each."""
    if len(streams) < 2 or writer_of(target).several:
        return {target: streams}
    # Some file systems take capital and small letters for the same.
    names = unique_files([_plain(stream.name) for stream in streams])
    return {
        target.with_name(f"{target.stem}-{name}{target.suffix}"): [stream]
        for name, stream in zip(names, streams, strict=True)
    }


def unique_files(names: Sequence[str]) -> list[str]:
    """Parts of file names with a number behind those that came before, in whatever letters."""
    folded = unique([name.casefold() for name in names])
    return [name + made.removeprefix(name.casefold()) for name, made in zip(names, folded, strict=True)]


def _plain(name: str) -> str:
    plain = "".join(letter if letter.isalnum() or letter in "-_." else "-" for letter in name)
    # A file name has 255 bytes, and a letter up to four.
    return plain.encode()[:LONGEST_PART].decode(errors="ignore")


def refuse_existing(targets: Sequence[Path]) -> None:
    """See that nothing is written over.

    Raises:
        ExportUsageError: a file is there, or the folder is not.
    """
    for target in targets:
        if not target.parent.is_dir():
            raise ExportUsageError(
                f"{target}: there is no folder {target.parent}; make it first", CANNOT_WRITE
            )
        if target.exists():
            raise ExportUsageError(
                f"{target} is there already; give another name, or --overwrite to replace it", THERE_ALREADY
            )


def write_all(
    files: Mapping[Path, Sequence[RecordedStream]], about: Mapping[str, str], *, force: bool
) -> list[str]:
    """Write all files, or none: beside their places first, and there when all are whole and on the disk.

    Args:
        files: by path, the streams of each; all in one folder.
        about: what is stated in each file: names of the fields, and their texts.
        force: replace what is there.

    Returns:
        What the files cannot hold, in sentences.

    Raises:
        ExportUsageError: a file is there, and must not be replaced.
        RecordingError: the format cannot hold these samples.
        OSError: they cannot be written.
    """
    if not force:
        refuse_existing(list(files))
    notes = []
    with _folder_beside(next(iter(files)).parent) as folder:
        for target, streams in files.items():
            notes += _write(target, folder / target.name, streams, about)
            with (folder / target.name).open("rb") as written:
                os.fsync(written.fileno())
        for target in files:
            _put(folder / target.name, target, force=force)
    return notes


def _write(
    target: Path, path: Path, streams: Sequence[RecordedStream], about: Mapping[str, str]
) -> list[str]:
    """Write one file; arguments and result as of `Writer.write`.

    Raises:
        RecordingError: the format cannot hold these samples.
        OSError: they cannot be written.
    """
    try:
        return writer_of(target).write(path, streams, about)
    except (OSError, RecordingError, ExportUsageError):
        raise
    except MemoryError:
        raise RecordingError(
            f"{target.name} takes more memory than there is; write .parquet or .csv, or one stream "
            "alone with --stream",
            NOT_HELD,
        ) from None
    except Exception as error:
        # What names, rates and times a format cannot hold its library states in words of its own.
        why = " ".join(str(error).split())[:LONGEST_REASON] or type(error).__name__
        raise RecordingError(
            f"{target.name} cannot hold this recording: {why}; write another format", NOT_HELD
        ) from error


@contextmanager
def _folder_beside(parent: Path) -> Iterator[Path]:
    folder = Path(tempfile.mkdtemp(prefix=".daqsvc-export-", dir=parent))
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _put(written: Path, target: Path, *, force: bool) -> None:
    """Put a file in its place, and never over one that has come there meanwhile."""
    if not force:
        try:
            target.hardlink_to(written)
        except FileExistsError:
            raise ExportUsageError(
                f"{target} has been written by somebody else meanwhile; give another name, or --overwrite",
                THERE_ALREADY,
            ) from None
        except OSError:
            pass  # a file system without hard links
        else:
            return
    written.replace(target)
