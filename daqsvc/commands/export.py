"""``daqsvc export``: a recording or snapshot as a file of another tool."""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Literal, TypedDict

from daqsvc.commands.arguments import EXIT_OK, EXIT_REFUSED, EXIT_USAGE, add_overwrite
from daqsvc.commands.complaint import complain
from daqsvc.commands.recording_options import add_channel_map, split_files
from daqsvc.commands.with_kernels import VerbWithKernels
from daqsvc.errors.command_line import CANNOT_WRITE, THERE_ALREADY
from daqsvc.errors.recordings import NO_SUCH_CHANNEL
from daqsvc.rounding import counted

if TYPE_CHECKING:
    import argparse
    from collections.abc import Mapping, Sequence

    from daqsvc.recording.streams import RecordedStream


class ExportCommand(VerbWithKernels):
    """``daqsvc export [MACHINE] RECORDING --to FILE``."""

    help = "write a recording, CAN log or snapshot as Parquet, CSV, WAV, MATLAB, UFF58 or MDF4"
    description = (
        "Write the samples of a recording, or of a snapshot of the service, as a file for another tool. "
        "The suffix of --to selects the format: Parquet, CSV, WAV, MATLAB, universal file (data sets "
        "58) or MDF 4. It reads all files that daqsvc analyze reads; a CAN log needs its machine file "
        "(.toml) before it. Names, units, rate, begin and gaps are written with the samples. If there "
        "are several streams, .mat, .uff and .mf4 contain all of them; with the other formats each "
        "stream gets its own file, whose name ends with the name of the stream."
    )

    def add_arguments(self, parser: argparse.ArgumentParser) -> None:
        """See `daqsvc.cli.Command.add_arguments`."""
        self._parser = parser
        parser.epilog = (
            "Exit code: 0 if it was written; 1 if the file cannot be written; 2 for wrong usage or a "
            "file that exists already; 3 if the recording cannot be read or the format cannot contain "
            "it."
        )
        parser.add_argument(
            "files",
            nargs="+",
            metavar="FILE",
            help="machine file (.toml) if there is one, then a recording",
        )
        parser.add_argument(
            "--to",
            type=Path,
            required=True,
            metavar="FILE",
            help="file to write: .parquet, .csv, .wav, .mat, .uff or .mf4",
        )
        parser.add_argument("--stream", metavar="NAME", help="write only this stream (default: all)")
        add_overwrite(parser)
        parser.add_argument("--json", action="store_true", help="print one JSON object instead of text")
        add_channel_map(parser.add_argument)

    def run(self, arguments: argparse.Namespace) -> int:
        """See `daqsvc.cli.Command.run`."""
        machine, recordings = split_files(arguments)
        if len(recordings) > 1 and machine is None and recordings[-1].lower().endswith(".toml"):
            machine, recordings = Path(recordings[-1]), recordings[:-1]
        if len(recordings) != 1:
            self._parser.error(
                f"{len(recordings)} recordings: name one, with a machine file in front if there is one"
            )
        from daqsvc.recording import RecordingError  # noqa: PLC0415 - each verb imports what it needs
        from daqsvc.recording.recording import set_memory, stop_reading  # noqa: PLC0415
        from daqsvc.recording.writers import ExportUsageError  # noqa: PLC0415

        set_memory(arguments.max_memory)
        try:
            return self._export(arguments, machine, recordings[0])
        except ExportUsageError as error:
            return complain("daqsvc export", error, error.code, EXIT_USAGE)
        except RecordingError as error:
            return complain("daqsvc export", error, error.code, EXIT_REFUSED)
        except OSError as error:
            # Libraries put their own words around the reason.
            why = os.strerror(error.errno) if error.errno else error
            return complain("daqsvc export", f"{arguments.to} is not written: {why}", CANNOT_WRITE)
        finally:
            stop_reading()

    def _export(self, arguments: argparse.Namespace, machine: Path | None, recording: str) -> int:
        """Do it.

        Raises:
            ExportUsageError: nothing can be written there.
            RecordingError: it cannot be read, or the format cannot hold it.
            OSError: it cannot be written.
        """
        from daqsvc.offline.exports import read_streams  # noqa: PLC0415 - as above
        from daqsvc.recording.writers import (  # noqa: PLC0415
            ExportUsageError,
            refuse_existing,
            targets_of,
            write_all,
            writer_of,
        )
        from daqsvc.settings.problems import choice  # noqa: PLC0415

        writer_of(arguments.to)
        if not arguments.overwrite:
            refuse_existing([arguments.to])
        loaded = None
        if machine is not None and (loaded := self._load(machine)) is None:
            return EXIT_USAGE
        self._prepare_kernel_cache()
        exported = read_streams(recording, loaded, arguments.map, arguments.fs)
        streams = exported.streams
        if arguments.stream is not None:
            streams = [one for one in streams if one.name == arguments.stream]
            if not streams:
                remedy = choice(arguments.stream, [one.name for one in exported.streams])
                raise ExportUsageError(
                    f"{recording} has no stream {arguments.stream!r}; {remedy}", NO_SUCH_CHANNEL
                )
        files = targets_of(arguments.to, streams)
        for target in files:
            if target.exists() and target.samefile(recording):
                raise ExportUsageError(
                    f"{target} is the recording itself, which nothing replaces; give another name",
                    THERE_ALREADY,
                )
        notes = exported.notes + write_all(files, exported.about, force=arguments.overwrite)
        for note in notes:
            print(f"daqsvc export: {note}", file=sys.stderr)  # noqa: T201 - stdout is for what was written
        document = _document(files, notes)
        print(json.dumps(document) if arguments.json else "\n".join(map(_line, document["files"])))  # noqa: T201
        return EXIT_OK


class ExportedStream(TypedDict):
    """A stream in a file that was written.

    Attributes:
        stream: its name.
        channels: names of its channels.
        units: unit of each channel; empty if it is not known.
        rate_hz: samples per second.
        start_time: time of the first sample, ISO 8601; null if the recording does not state it.
        samples: how many there are of a channel.
        missing: how many of them are not there.
    """

    stream: str
    channels: list[str]
    units: list[str]
    rate_hz: float
    start_time: str | None
    samples: int
    missing: int


class ExportedFile(TypedDict):
    """A file that was written.

    Attributes:
        file: its path.
        streams: the streams in it.
    """

    file: str
    streams: list[ExportedStream]


class Export(TypedDict):
    """What was written.

    Attributes:
        schema: what the object is, and of which version.
        files: the files that were written.
        notes: what a person should know of them, in sentences.
    """

    schema: Literal["daqsvc.export/1"]
    files: list[ExportedFile]
    notes: list[str]


def _document(files: Mapping[Path, Sequence[RecordedStream]], notes: list[str]) -> Export:
    return {
        "schema": "daqsvc.export/1",
        "files": [
            {
                "file": str(path),
                "streams": [
                    {
                        "stream": one.name,
                        "channels": list(one.names),
                        "units": list(one.units),
                        "rate_hz": one.rate_hz,
                        "start_time": one.start or None,
                        "samples": len(one.samples),
                        "missing": one.missing(),
                    }
                    for one in streams
                ],
            }
            for path, streams in files.items()
        ],
        "notes": notes,
    }


def _line(written: ExportedFile) -> str:
    from daqsvc.recording.streams import printable  # noqa: PLC0415 - as above

    # The name of a file may be bytes that are no text.
    file = printable(written["file"])
    return "\n".join(
        f"{file}: {one['stream']}, {', '.join(one['channels'])} at {one['rate_hz']:g} Hz, "
        f"{one['samples'] / one['rate_hz']:.4g} s"
        + (f", {counted(one['missing'], 'sample')} missing" if one["missing"] else "")
        for one in written["streams"]
    )
