"""Small files that unpack to a thousand times as much, or say that they do."""

from __future__ import annotations

import gzip
import io
import struct
import zipfile
import zlib
from typing import TYPE_CHECKING

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

if TYPE_CHECKING:
    from pathlib import Path

UNPACKED_BYTES = 300_000_000

_ZEROS = bytes(1_000_000)


def _packed(head: bytes, piece: bytes, count: int, window: int) -> bytes:
    """What ``head`` and many times ``piece`` are packed to."""
    packing = zlib.compressobj(9, zlib.DEFLATED, window)
    packed = [packing.compress(head), *(packing.compress(piece) for _ in range(count)), packing.flush()]
    return b"".join(packed)


def csv_gz() -> bytes:
    row = b"0,0\n" * 250_000
    return _packed(b"x,y\n", row, UNPACKED_BYTES // len(row), 31)


def npz(name: str = "x") -> bytes:
    stream = io.BytesIO()
    with (
        zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive,
        archive.open(f"{name}.npy", "w") as file,
    ):
        header = {"descr": "<f8", "fortran_order": False, "shape": (UNPACKED_BYTES // 8,)}
        np.lib.format.write_array_header_1_0(file, header)
        for _ in range(UNPACKED_BYTES // len(_ZEROS)):
            file.write(_ZEROS)
    return stream.getvalue()


def npz_of_many_that_share_their_bytes() -> bytes:
    """As of D. Fifield: the members of an archive overlap."""
    array = io.BytesIO()
    np.save(array, np.zeros(200_000))
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("x0.npy", array.getvalue())
        (first,) = archive.infolist()
        for i in range(1, 1000):
            twin = zipfile.ZipInfo(f"x{i}.npy")
            for field in ("compress_type", "CRC", "compress_size", "file_size", "header_offset"):
                setattr(twin, field, getattr(first, field))
            archive.filelist.append(twin)
    return stream.getvalue()


def npz_that_says_too_much() -> bytes:
    stream = io.BytesIO()
    array = io.BytesIO()
    header = {"descr": "<f8", "fortran_order": False, "shape": (10**12,)}
    np.lib.format.write_array_header_1_0(array, header)
    with zipfile.ZipFile(stream, "w") as archive:
        archive.writestr("x.npy", array.getvalue() + bytes(800))
    return stream.getvalue()


def mat() -> bytes:
    samples = UNPACKED_BYTES // 8
    head = struct.pack("<IIII", 6, 8, 6, 0) + struct.pack("<IIii", 5, 8, samples, 1)
    head += struct.pack("<HH4s", 1, 1, b"x\0\0\0") + struct.pack("<II", 9, 8 * samples)
    body = struct.pack("<II", 14, len(head) + 8 * samples) + head
    packed = _packed(body, _ZEROS, UNPACKED_BYTES // len(_ZEROS), 15)
    text = b"MATLAB 5.0 MAT-file".ljust(124) + struct.pack("<H2s", 0x0100, b"IM")
    return text + struct.pack("<II", 15, len(packed)) + packed


def parquet() -> bytes:
    stream = io.BytesIO()
    zeros = pa.array(np.zeros(1_000_000))
    schema = pa.schema([("x", pa.float64())])
    with pq.ParquetWriter(stream, schema, compression="zstd") as writer:
        for _ in range(UNPACKED_BYTES // 8_000_000):
            writer.write_table(pa.table([zeros], schema=schema))
    return stream.getvalue()


BOMBS = {
    "a.csv.gz": csv_gz,
    "a.npz": npz,
    "b.npz": npz_of_many_that_share_their_bytes,
    "a.mat": mat,
    "a.parquet": parquet,
}


def write(folder: Path, name: str) -> Path:
    """A bomb as a file."""
    path = folder / name
    path.write_bytes(BOMBS[name]())
    assert path.stat().st_size < 2_000_000
    return path


def text_log_gz() -> bytes:
    """A candump log of nothing but lines that are no frames."""
    return gzip.compress(b"\n" * 1_000_000)
