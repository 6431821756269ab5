"""Make the pictures of docs/pictures: ``make pictures``, or some of them: ``make pictures ARGS=timebase``."""

from __future__ import annotations

import argparse
from pathlib import Path

from make_pictures.catalogue import PICTURES
from make_pictures.style import save, use

FOLDER = Path(__file__).parents[1] / "pictures"


def main() -> None:
    """Draw and save."""
    parser = argparse.ArgumentParser(prog="make pictures", description="Make docs/pictures again.")
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"of them ({', '.join(PICTURES)})")
    parser.add_argument("--out", type=Path, default=FOLDER, help="another folder")
    arguments = parser.parse_args()
    if unknown := [name for name in arguments.names if name not in PICTURES]:
        parser.error(f"there is no picture {unknown[0]!r}; there are {', '.join(PICTURES)}")
    use()
    for name in arguments.names or PICTURES:
        save(PICTURES[name](), arguments.out / f"{name}.svg")


if __name__ == "__main__":
    main()
