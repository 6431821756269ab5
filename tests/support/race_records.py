"""The measured recordings that the race test is judged on, with what is known of them."""

from __future__ import annotations

import csv
from dataclasses import dataclass
from typing import TYPE_CHECKING

from scipy.io import loadmat

from daqsvc.bearing.geometry import BearingOrders, bearing_orders
from daqsvc.recording.recording import load_recording

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    import numpy as np

# As stated with the recordings.
MFPT = BearingOrders(inner=4.755, outer=3.245, ball=2.175, cage=0.4056)
# The type is not stated: races as measured from the data, ball and cage of the 6203, which has such races.
ADI = BearingOrders(inner=4.95, outer=3.05, ball=1.992, cage=0.3817)
PARTS = {"I": "inner", "O": "outer", "B": "ball"}


@dataclass(frozen=True)
class Record:
    """A channel of a recording.

    Attributes:
        rig: the set that it belongs to.
        name: of the record in it.
        truth: the damaged part, or "normal".
        what: size and place of the damage, as the set names it.
        grade: best diagnosis by Smith and Randall (2015): Y clear, P partial, N not; empty if not graded.
        samples: ``[n]``.
        rate_hz: sample rate.
        speed_rpm: as stated.
        bearing: fault orders of the bearing that is judged.
    """

    rig: str
    name: str
    truth: str
    what: str
    grade: str
    samples: np.ndarray
    rate_hz: float
    speed_rpm: float
    bearing: BearingOrders


def all_records(data: Path) -> Iterator[Record]:
    """Drive end of CWRU, MFPT, and axis Y of the ADI rig."""
    yield from cwru(data)
    yield from mfpt(data)
    yield from adi(data, "Y")


def cwru(data: Path, end: str = "DE") -> Iterator[Record]:
    """Case Western Reserve University; the fan end's bearing is in good order in all of them."""
    with (data / "smith_randall_2015.csv").open(encoding="utf-8") as table:
        known = {row["record"]: row for row in csv.DictReader(table)}
    bearing = bearing_orders("6205-2RS" if end == "DE" else "6203-2RS")
    for path in sorted((data / "cwru").glob("*.mat"), key=lambda path: int(path.stem)):
        channels = {k: v for k, v in loadmat(path).items() if k.endswith(f"{end}_time")}
        # Some files hold a second record beside their own.
        own = [k for k in channels if k.startswith(f"X{int(path.stem):03d}")] or list(channels)
        if not own:
            continue
        row = known.get(path.stem)
        truth = PARTS[row["fault"][0]] if row and end == "DE" else "normal"
        yield Record(
            rig=f"CWRU {end}",
            name=path.stem,
            truth=truth,
            what=row["fault"] if row else "healthy",
            grade=row["sr2015_best_grade"] if row else "",
            samples=channels[own[0]].ravel(),
            rate_hz=12_000.0 if row else 48_000.0,
            speed_rpm=float(row["nominal_rpm"]) if row else 1797.0,
            bearing=bearing,
        )


def mfpt(data: Path) -> Iterator[Record]:
    """Society for Machinery Failure Prevention Technology."""
    for path in sorted((data / "mfpt" / "train").glob("*.mat")):
        bearing = loadmat(path)["bearing"][0, 0]
        yield Record(
            rig="MFPT",
            name=path.stem,
            truth=PARTS.get(path.stem[0], "normal"),
            what="",
            grade="",
            samples=bearing["gs"].ravel(),
            rate_hz=float(bearing["sr"].item()),
            speed_rpm=1500.0,
            bearing=MFPT,
        )


def adi(data: Path, axis: str) -> Iterator[Record]:
    """Analog Devices' three-axis sensor on a machinery fault simulator."""
    for path in sorted((data / "adi_cbm" / "Data_ADXL356C").glob("*.gz")):
        name = path.name.split(".")[0]
        part = name.split("_")[1]
        channel = {axis: str(1 + "XYZ".index(axis))}
        yield Record(
            rig=f"ADI {axis}",
            name=name,
            truth="normal" if part == "GoB" else PARTS["B" if part[1:] == "BF" else part[1]],
            what="",
            grade="",
            samples=load_recording(path, channel, 20_000.0).samples[:, 0],
            rate_hz=20_000.0,
            speed_rpm=float(name[:4]),
            bearing=ADI,
        )
