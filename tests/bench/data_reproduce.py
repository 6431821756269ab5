"""Write the table of docs/reproduce.md anew: the paper's experiments by ``daqsvc reproduce``.

Run by ``make bench-data``; takes some 30 s of one core.
"""

# ruff: noqa: T201 - printing is what it is for

from __future__ import annotations

import subprocess
import sys
import tempfile
from pathlib import Path

PAGE = Path(__file__).parents[2] / "docs" / "reproduce.md"
BEGIN, END = "<!-- table: daqsvc reproduce -->", "<!-- end of table -->"


def main() -> int:
    """Run the experiments and put their table into the page."""
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "daqsvc", "reproduce", "--out", folder]
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
        written = (Path(folder) / "results.md").read_text("utf-8")
    table = written[written.index("| figure |") :].strip()
    before, rest = PAGE.read_text("utf-8").split(BEGIN)
    PAGE.write_text(f"{before}{BEGIN}\n{table}\n{END}{rest.split(END)[1]}", "utf-8")
    print(table)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
