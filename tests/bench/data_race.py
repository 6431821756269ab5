"""Write the tables of docs/race-test.md anew: the race test on all measured recordings, and on noise.

Run by ``make bench-data``. The recordings lie where DAQSVC_DATA points (default: ../shared/data).
"""

# ruff: noqa: T201 - printing is what it is for

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT / "tests"))

from support import race_records  # noqa: E402 - lies beside the tests that use it
from support.race_signals import BEARING, SPEED_RPM  # noqa: E402

from daqsvc.bearing.race import race_test  # noqa: E402

if TYPE_CHECKING:
    from collections.abc import Iterable

    from support.race_records import Record

    from daqsvc.bearing.race import PartEvidence, RaceVerdict

PAGE = ROOT / "docs" / "race-test.md"
BEGIN, END = "<!-- table: make bench-data -->", "<!-- end of table -->"
WINDOW_S = 2.5
NOISE_WINDOWS = 2500


def judge(record: Record, *, speed: float = 1.0, window: slice | None = None) -> RaceVerdict:
    """The verdict on a record or a window of it."""
    samples = record.samples[window or slice(None)]
    return race_test(samples, record.rate_hz, speed * record.speed_rpm, record.bearing)


def windows(record: Record) -> list[slice]:
    """The record in windows of 2.5 s; whole, if it is shorter."""
    length = min(int(WINDOW_S * record.rate_hz), len(record.samples))
    return [slice(i, i + length) for i in range(0, len(record.samples) - length + 1, length)]


def count(title: str, judged: Iterable[tuple[Record, RaceVerdict]]) -> str:
    """A row of right, missed and wrong answers by truth."""
    cells = []
    pairs = list(judged)
    for truth in ("inner", "outer", "ball", "normal"):
        found = [v.verdict for r, v in pairs if r.truth == truth]
        right = found.count(truth)
        missed = found.count("normal") if truth != "normal" else 0
        cells.append(f"{right} / {missed} / {len(found) - right - missed}" if found else "-")
    return f"| {title} | {' | '.join(cells)} |"


def summary(records: list[Record], far: list[Record], other_axes: list[Record]) -> list[str]:
    """Counts by set and way of looking."""
    lines = ["| records | inner | outer | ball | normal |", "|---|---|---|---|---|"]
    for rig in dict.fromkeys(r.rig for r in records):
        own = [r for r in records if r.rig == rig]
        lines.append(count(f"{rig}, whole", [(r, judge(r)) for r in own]))
        pieces = [(r, judge(r, window=w)) for r in own for w in windows(r)]
        lines.append(count(f"{rig}, windows of {WINDOW_S} s", pieces))
        for speed in (0.99, 1.01):
            title = f"{rig}, whole, speed stated {speed - 1.0:+.0%} wrong"
            lines.append(count(title, [(r, judge(r, speed=speed)) for r in own]))
    lines.append(count("CWRU, good fan end of damaged machines", [(r, judge(r)) for r in far]))
    lines.append(count("ADI, the other two axes", [(r, judge(r)) for r in other_axes]))
    return lines


def cell(e: PartEvidence) -> str:
    """Significance and size of a part."""
    return f"{e.z:.1f} / {e.depth:.2f}" + ("" if e.testable else " (not testable)")


def rows(records: list[Record]) -> list[str]:
    """A row for every record."""
    titles = ("record", "truth", "verdict", "margin", "inner z / depth", "outer", "ball", "S&R 2015")
    lines = [f"| {' | '.join(titles)} |", "|---" * len(titles) + "|"]
    for r in records:
        v = judge(r)
        parts = " | ".join(cell(e) for e in v.evidence.values())
        margin = f"{v.margin:.1f}" if v.margin < 10.0 else "> 10"
        name = " ".join(part for part in (r.rig, r.name, r.what) if part)
        lines.append(f"| {name} | {r.truth} | {v.verdict} | {margin} | {parts} | {r.grade} |")
    return lines


def noise() -> str:
    """Alarms and the largest severity in windows of Gaussian noise."""
    random = np.random.default_rng(7)
    alarms, largest = 0, 0.0
    for _ in range(NOISE_WINDOWS):
        v = race_test(random.standard_normal(int(WINDOW_S * 12_000)), 12_000.0, SPEED_RPM, BEARING)
        alarms += v.verdict != "normal"
        largest = max(largest, *(e.severity for e in v.evidence.values()))
    return (
        f"{NOISE_WINDOWS} windows of Gaussian noise ({WINDOW_S} s at 12 kHz): {alarms} alarms; "
        f"largest severity {largest:.2f} against a limit of 2.2."
    )


def main() -> int:
    """Write the tables; 1 if there are no recordings."""
    data = Path(os.environ.get("DAQSVC_DATA", ROOT / ".." / "shared" / "data")).resolve()
    if not data.is_dir():
        print(f"no recordings at {data}; set DAQSVC_DATA to where they are", file=sys.stderr)
        return 1
    records = list(race_records.all_records(data))
    far = list(race_records.cwru(data, "FE"))
    other_axes = [r for axis in "XZ" for r in race_records.adi(data, axis)]
    table = "\n".join(
        [
            "Right / missed / wrong. A wrong answer is another part, or any where none is damaged.",
            "",
            *summary(records, far, other_axes),
            "",
            noise(),
            "",
            *rows(records),
        ]
    )
    page = PAGE.read_text(encoding="utf-8")
    before, rest = page.split(BEGIN)
    PAGE.write_text(f"{before}{BEGIN}\n{table}\n{END}{rest.split(END)[1]}", encoding="utf-8")
    print(table)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
