"""Recordings that are damaged, lie about themselves, or were made to do harm; each a file of some kB."""

from __future__ import annotations

import gzip
import io
import pickle
import struct
import zipfile
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any, cast

import can
import h5py
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from scipy.io import savemat, wavfile
from support.foreign_files import WRITERS
from support.fuzz_bytes import mutated

if TYPE_CHECKING:
    from collections.abc import Callable

RATE_HZ = 1000
SAMPLES = np.random.default_rng(5).normal(size=(60, 2))


def _npz(**arrays: Any) -> bytes:
    stream = io.BytesIO()
    np.savez_compressed(stream, **arrays)
    return stream.getvalue()


def _mat(content: dict[str, object], *, packed: bool = True) -> bytes:
    stream = io.BytesIO()
    savemat(cast("Any", stream), content, do_compression=packed)
    return stream.getvalue()


def _wav(samples: np.ndarray) -> bytes:
    stream = io.BytesIO()
    wavfile.write(stream, RATE_HZ, samples)
    return stream.getvalue()


def _parquet(table: pa.Table) -> bytes:
    stream = io.BytesIO()
    pq.write_table(table, stream)
    return stream.getvalue()


def _csv(samples: np.ndarray = SAMPLES) -> bytes:
    rows = [f"{k / RATE_HZ},{x!r},{y!r}\n" for k, (x, y) in enumerate(samples.tolist())]
    return "".join(["t,x,y\n", *rows]).encode()


_CHANNELS = {"x": SAMPLES[:, 0], "y": SAMPLES[:, 1]}


def _foreign(ending: str) -> bytes:
    """As the library of the format writes it."""
    with TemporaryDirectory() as folder:
        path = Path(folder) / f"sound{ending}"
        WRITERS[ending](path, _CHANNELS, RATE_HZ, "g")
        return path.read_bytes()


SOUND: dict[str, bytes] = {
    ".npz": _npz(**_CHANNELS, t=np.arange(60) / RATE_HZ, label="healthy"),
    ".mat": _mat({**_CHANNELS, "rig": {"name": "hall 3"}, "parts": np.array([1.0, "a"], dtype=object)}),
    ".csv": _csv(),
    ".csv.gz": gzip.compress(_csv()),
    ".wav": _wav(SAMPLES.astype(np.float32)),
    ".parquet": _parquet(pa.table(_CHANNELS)),
    **{ending: _foreign(ending) for ending in WRITERS},
}
"""Sound files, by the ends of their names."""


class _Harm:
    """What a pickle does when it is loaded: it leaves a trace."""

    def __init__(self, trace: Path) -> None:
        self.trace = trace

    def __reduce__(self) -> tuple[Callable[..., object], tuple[object, ...]]:
        return Path.touch, (self.trace,)


def pickles(trace: Path) -> dict[str, bytes]:
    """Files that would run code if Python objects in them were loaded."""
    objects = np.array([_Harm(trace)], dtype=object)
    member = io.BytesIO()
    np.lib.format.write_array_header_1_0(member, {"descr": "<f8", "fortran_order": False, "shape": (3,)})
    bare = io.BytesIO()
    with zipfile.ZipFile(bare, "w") as archive:
        archive.writestr("x.npy", pickle.dumps(_Harm(trace)))
    return {
        "objects.npz": _npz(**_CHANNELS, z=objects),
        "bare.npz": bare.getvalue(),
        "pickle.npz": pickle.dumps(_Harm(trace)),
        "pickle.mat": pickle.dumps(_Harm(trace)),
    }


def _member(header: str, body: bytes = b"") -> bytes:
    """An archive with one array whose header is as given."""
    text = header.encode().ljust(118) + b"\n"
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as archive:
        archive.writestr("x.npy", b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text + body)
    return stream.getvalue()


def _npy(descr: str, shape: str, body: bytes = bytes(160)) -> bytes:
    return _member(f"{{'descr': {descr}, 'fortran_order': False, 'shape': {shape}, }}", body)


def _nested_cells(depth: int) -> bytes:
    """MATLAB cells in each other; their layout is that of MathWorks, "MAT-File Format", level 5."""

    def array(kind: int, name: bytes, inside: bytes) -> bytes:
        flags = struct.pack("<IIII", 6, 8, kind, 0) + struct.pack("<IIii", 5, 8, 1, 1)
        named = struct.pack("<II", 1, len(name)) + name.ljust(-(-len(name) // 8) * 8, b"\0")
        return struct.pack("<II", 14, len(flags + named + inside)) + flags + named + inside

    cell = array(6, b"", struct.pack("<IId", 9, 8, 1.0))
    for level in range(depth):
        cell = array(1, b"x" if level == depth - 1 else b"", cell)
    return b"MATLAB 5.0 MAT-file".ljust(124) + struct.pack("<H2s", 0x0100, b"IM") + cell


def _wav_header(channels: int, bits: int, size: int) -> bytes:
    form = struct.pack("<HHIIHH", 1, channels, RATE_HZ, 0, channels * bits // 8 % 65536, bits)
    return (
        b"RIFF" + struct.pack("<I", 2**32 - 1) + b"WAVE"
        b"fmt " + struct.pack("<I", len(form)) + form + b"data" + struct.pack("<I", size) + bytes(400)
    )


def _h5(**sets: tuple[tuple[int, ...], str]) -> bytes:
    """Data sets by their shapes and types, of which nothing is written."""
    stream = io.BytesIO()
    with h5py.File(stream, "w") as file:
        for name, (shape, dtype) in sets.items():
            file.create_dataset(name, shape, dtype, chunks=True)
    return stream.getvalue()


def _tdms(count: int) -> bytes:
    """A segment whose only channel states that it has so many samples,

    Layout: NI, "TDMS File Format Internal Structure".
    """

    def text(value: str) -> bytes:
        return struct.pack("<I", len(value)) + value.encode()

    channel = text("/'run'/'x'") + struct.pack("<IIIQ", 20, 10, 1, count) + struct.pack("<I", 0)
    body = struct.pack("<I", 1) + channel
    lead = b"TDSm" + struct.pack("<IIQQ", 0b1110, 4713, len(body) + 80, len(body))
    return lead + body + bytes(80)


def structures() -> dict[str, bytes]:
    """Files whose parts are sound and whose whole is not; none can be judged."""
    return {
        "many.tdms": _tdms(2**62),
        "objects.tdms": b"TDSm" + struct.pack("<IIQQI", 0b1110, 4713, 2**40, 2**40, 2**32 - 1),
        "empty.tdms": b"",
        "zero.mf4": bytes(4000),
        "empty.mf4": b"",
        "header.mf4": b"MDF     4.10    " + bytes(200),
        "links.mf4": b"MDF     4.10    " + SOUND[".mf4"][16:64] + b"\xff" * 400,
        "empty.uff": b"",
        "functions.uff": b"    -1\n    58\n    -1\n" * 50_000,
        "words.uff": b"    -1\n    58\n" + b"NONE\n" * 40 + b"    -1\n",
        "empty.h5": b"",
        "shape.h5": _h5(x=((10**12,), "f8")),
        "cube.h5": _h5(x=((3, 3, 3), "f8")),
        "columns.h5": _h5(x=((5_000, 5_000), "i1")),
        "texts.h5": _h5(x=((3,), "S9")),
        "columns.csv": b",".join(b"c%d" % i for i in range(1_000_000)) + b"\n" + b"0," * 999_999 + b"0\n",
        "line.csv": b"x\n" + b"1" * 3_000_000,
        "ragged.csv": b"x,y\n" + b"1,2\n" * 30 + b"1,2,3,4\n1\n",
        "words.csv": b"x,y\n" + b"a,b\n" * 30,
        "zero.csv": bytes(4000),
        "quote.csv": b'x,y\n1,2\n"3,4\n' + b"5,6\n" * 30,
        "nan.csv": b"x,y\n" + b"nan,inf\n" * 60,
        "twice.csv.gz": gzip.compress(_csv()) + b"garbage behind it",
        "empty.npz": _npz(),
        "shape.npz": _npy("'<f8'", "(1000000000000,)"),
        "negative.npz": _npy("'<f8'", "(-5,)"),
        "overflow.npz": _npy("'<f8'", f"({2**63}, {2**63})"),
        "text.npz": _npy("'<U500000000'", "(3,)"),
        "void.npz": _npy("'|V2000000000'", "(1,)"),
        "nothing.npz": _npy("'<U0'", f"({10**17},)"),
        "kind.npz": _npy("'no such kind'", "(3,)"),
        "code.npz": _member("__import__('os').abort()"),
        "cube.npz": _npz(x=np.zeros((3, 3, 3))),
        "cells.mat": _nested_cells(200),
        "deep.mat": _nested_cells(2000),
        "scalars.mat": _mat({"x": 1.0}),
        "complex.mat": _mat({"x": np.ones(30) * 1j}),
        "channels.wav": _wav_header(0, 16, 400),
        "many.wav": _wav_header(65_535, 8, 400),
        "bits.wav": _wav_header(1, 17, 400),
        "long.wav": _wav_header(1, 16, 2**32 - 1),
        "texts.parquet": _parquet(pa.table({"x": ["a"] * 30})),
        "none.parquet": _parquet(pa.table({})),
        "rows.parquet": _parquet(pa.table({"x": pa.array([], pa.float64())})),
        "lists.parquet": _parquet(pa.table({"x": [[1.0, 2.0]] * 30})),
        "nulls.parquet": _parquet(pa.table({"x": pa.array([None] * 30, pa.float64())})),
    }


def spoilt(rng: np.random.Generator, ending: str) -> bytes:
    """A sound file with some bytes changed, cut, repeated or replaced."""
    return mutated(rng, SOUND[ending])


def can_log(ending: str, messages: list[can.Message], folder: Path) -> bytes:
    """A CAN log of these messages."""
    path = folder / f"sound{ending}"
    with can.Logger(path) as logger:
        for message in messages:
            logger.on_message_received(message)
    content = path.read_bytes()
    path.unlink()
    return content
