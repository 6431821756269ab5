"""Recordings as the libraries of other formats write them: TDMS, MDF 4, UFF 58 and HDF5."""

from __future__ import annotations

import warnings
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

import asammdf
import h5py
import nptdms
import numpy as np
import pyuff

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping
    from pathlib import Path

    from numpy.typing import NDArray

START = "2026-01-31T12:00:00"


def write_tdms(path: Path, channels: Mapping[str, NDArray[Any]], rate_hz: float, unit: str) -> None:
    """A group with a waveform for each channel."""
    objects = [
        nptdms.ChannelObject(
            "run",
            name,
            samples,
            {
                "wf_increment": 1.0 / rate_hz,
                "unit_string": unit,
                "wf_start_time": np.datetime64(START),
                "wf_samples": len(samples),
            },
        )
        for name, samples in channels.items()
    ]
    with nptdms.TdmsWriter(path) as writer:
        writer.write_segment([nptdms.RootObject({"site": "hall 3"}), *objects])


def write_mf4(path: Path, channels: Mapping[str, NDArray[Any]], rate_hz: float, unit: str) -> None:
    """A group with one time for all channels."""
    with asammdf.MDF(version="4.10") as mdf:
        times = np.arange(len(next(iter(channels.values())))) / rate_hz
        mdf.append([asammdf.Signal(samples, times, unit, name) for name, samples in channels.items()])
        mdf.start_time = datetime.fromisoformat(START).replace(tzinfo=UTC)
        mdf.save(path, overwrite=True, compression=1)


def write_uff(path: Path, channels: Mapping[str, NDArray[Any]], rate_hz: float, unit: str) -> None:
    """A binary data set for each channel."""
    write_uff_of(path, channels, rate_hz, unit, binary=True)


def write_uff_of(
    path: Path, channels: Mapping[str, NDArray[Any]], rate_hz: float, unit: str, **more: Any
) -> None:
    """A data set for each channel; ``more`` are fields of `pyuff.prepare_58`."""
    path.unlink(missing_ok=True)
    file = pyuff.UFF(str(path))
    for node, (name, samples) in enumerate(channels.items(), 1):
        said = {
            "binary": 0,
            "func_type": 1,
            "id1": name,
            "id3": "31-Jan-26 12:00:00",
            "rsp_node": node,
            "rsp_dir": 3,
            "ref_node": 0,
            "ref_dir": 0,
            "ordinate_spec_data_type": 12,
            "orddenom_spec_data_type": 0,
            "abscissa_spacing": 1,
            "abscissa_spec_data_type": 17,
            "ordinate_axis_units_lab": unit,
            "x": np.arange(len(samples)) / rate_hz,
            "data": np.asarray(samples, np.float64),
        } | {key: int(value) if isinstance(value, bool) else value for key, value in more.items()}
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ResourceWarning)  # of binary files pyuff leaves one open
            file.write_sets(pyuff.prepare_58(**said), "add")


def write_h5(path: Path, channels: Mapping[str, NDArray[Any]], rate_hz: float, unit: str) -> None:
    """A packed data set for each channel in a group that states the rate."""
    with h5py.File(path, "w") as file:
        run = file.create_group("run")
        run.attrs["sample_rate"] = rate_hz
        file.attrs["start_time"] = START
        for name, samples in channels.items():
            run.create_dataset(name, data=samples, compression="gzip").attrs["units"] = unit


WRITERS: Mapping[str, Callable[[Path, Mapping[str, NDArray[Any]], float, str], None]] = {
    ".tdms": write_tdms,
    ".mf4": write_mf4,
    ".uff": write_uff,
    ".h5": write_h5,
}
"""By the ends of files' names."""
