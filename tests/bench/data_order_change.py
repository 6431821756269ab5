"""Write the table of docs/order-change.md anew: the runs of the ADI rig against its balanced ones.

Run by ``make bench-data``. The recordings lie where DAQSVC_DATA points (default: ../shared/data).
"""

# ruff: noqa: T201 - printing is what it is for

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from daqsvc.dsp.orders import order_vectors
from daqsvc.recording.recording import load_recording
from daqsvc.rotor.orders import compare_orders

if TYPE_CHECKING:
    from daqsvc.dsp.orders import OrderVectors

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs" / "order-change.md"
BEGIN, END = "<!-- table: make bench-data -->", "<!-- end of table -->"
RATE_HZ = 20_000.0
BALANCED = "GoB_GS_BaLo_WA_00lb"


def measured(path: Path) -> OrderVectors:
    """The orders of a recording, at the speed that its name states."""
    recording = load_recording(path, {"X": "1", "Y": "2", "Z": "3"}, RATE_HZ)
    return order_vectors(recording.samples, RATE_HZ, float(path.name[:4]), recording.names)


def rows(folder: Path) -> list[str]:
    """A row of the table for every recording."""
    found = {path.name.split(".")[0]: measured(path) for path in sorted(folder.glob("*.gz"))}
    lines = []
    for name, orders in found.items():
        change = compare_orders(found[f"{name[:4]}_{BALANCED}"], orders)
        axes = " / ".join(f"{1e3 * amplitude:.2f}" for amplitude in change.present[0])
        ratios = " / ".join(f"{ratio:.1f}" for ratio in change.ratio[0])
        rest = " / ".join(f"{ratio:.1f}" for ratio in change.residual_ratio)
        lines.append(
            f"| {name} | {orders.speed_rpm:.1f} ±{orders.speed_uncertainty_rpm:.1f} | {axes} | {ratios} "
            f"| {change.growth:.2f} ±{change.growth_uncertainty:.2f} | {change.departure:.1f} | {rest} "
            f"| {', '.join(change.group)} |"
        )
    return lines


def main() -> int:
    """Write the table; 1 if there are no recordings."""
    folder = Path(os.environ.get("DAQSVC_DATA", ROOT / ".." / "shared" / "data")) / "adi_cbm/Data_ADXL356C"
    if not folder.is_dir():
        print(f"no recordings at {folder}; set DAQSVC_DATA to where they are", file=sys.stderr)
        return 1
    titles = (
        "recording",
        "rpm by the harmonics",
        "1X of X / Y / Z, mV",
        "over balanced",
        "1X vector over balanced",
        "departure, nats",
        "residual over balanced",
        "verdict and group",
    )
    head = [f"| {' | '.join(titles)} |", "|---" * len(titles) + "|"]
    page = PAGE.read_text(encoding="utf-8")
    before, rest = page.split(BEGIN)
    table = "\n".join([*head, *rows(folder)])
    PAGE.write_text(f"{before}{BEGIN}\n{table}\n{END}{rest.split(END)[1]}", encoding="utf-8")
    print(table)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
