"""The behaviour guard: what users see, as golden texts that a change of the code must leave as they are.

::

    make guard                           # everything; exit code 1 and a diff if anything is not as before
    make guard ARGS=--take               # keep what comes out now, and print what has changed: is it meant?
    make guard ARGS="--only usage keys"  # some parts only
    make guard ARGS=--fast               # all but the recordings; the tests run these parts, too

The parts, and their texts in `golden/`:

``examples``
    What `check` and `example` print of all machine files in config/ and of `specimens/`, which have every
    key that there is. (check, example)
``detectability``
    What `detectability` prints of the same files. (detectability)
``broken``
    What `check` says of some 880 wrong machine files, made as `broken.py` tells: line, key, value, remedy
    and exit code. (broken-tables, broken-together, broken-text)
``schemas``
    The published schemas of payloads, byte for byte. (schemas)
``usage``
    All help texts; what is said of wrong options, values and combinations. (help, usage, usage-values)
``keys``
    Topics, keys of payloads, of status and of the verbs' JSON: names and structure, no values. (messages)
``cwru``, ``adi``, ``ross``, ``mfpt``, ``logs``, ``others``
    `analyze --json` and `calibrate --json` of every recording in $DAQSVC_DATA: verdict and SHA-256 of every
    digit. The whole JSON is kept in .cache/guard/, from where a difference is shown key by key.
    (recordings-...)

What the texts could depend on beside the code is set for each call (`verbs.workplace`: width of the
terminal, time zone, home, user, a folder whose path has the same length everywhere). The kernels of the
linear algebra library and of numpy are those of a processor with AVX2 (`_PROCESSOR`). Should digests of
recordings differ on another computer all the same, take them there before a change of the code and compare
after it. Normalised in the texts are only the folder (``<here>``), this computer's memory in two messages
(``<memory>``), when a calibration was written (``<time>``), and in keys the names of modes.

The parts call the console script's `main` in this process and start processes of `daqsvc`. They know no
module below, so that a new layout of the code changes nothing here.
"""

# ruff: noqa: T201 - printing is what it is for

from __future__ import annotations

import argparse
import multiprocessing
import os
import sys
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

_PROCESSOR = {
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    # The last digits of figures depend on the order of sums, which depends on the width of vectors.
    "OPENBLAS_CORETYPE": "Haswell",
    "NPY_DISABLE_CPU_FEATURES": "AVX512F AVX512CD AVX512_SKX AVX512_CLX AVX512_CNL AVX512_ICL AVX512_SPR",
}
ROOT = Path(__file__).parents[2]


def _restarted() -> None:
    """Begin again with the surroundings that must stand before numpy is imported."""
    wanted = {
        **_PROCESSOR,
        "PYTHONPATH": os.pathsep.join([str(ROOT), str(ROOT / "tests")]),
        "PYTHONHASHSEED": "0",
        "PYTHONWARNINGS": "ignore::ImportWarning",
    }
    if any(os.environ.get(name) != value for name, value in wanted.items()):
        os.environ.update(wanted)
        os.execv(sys.executable, [sys.executable, "-m", "guard", *sys.argv[1:]])  # noqa: S606 - itself


def _group(name: str) -> str:
    return name.removeprefix("recordings-").removesuffix(".txt")


def main() -> int:
    """Compare, or take; 0 if nothing differs or all was taken."""
    from guard.golden import FOLDER, TAKE, compare, take, unwanted
    from guard.parts import FAST, run
    from guard.recordings import DATA, GROUPS, TAKEN_ON, differences, keep_taken, processor

    parts = (*GROUPS, *FAST)
    parser = argparse.ArgumentParser(prog="make guard ARGS=...", description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("--take", action="store_true", help="keep what comes out now as the golden texts")
    parser.add_argument("--only", nargs="+", choices=parts, metavar="PART", help=f"of {', '.join(parts)}")
    parser.add_argument("--fast", action="store_true", help="all parts but the recordings")
    parser.add_argument(
        "--golden", type=Path, default=FOLDER, metavar="DIR", help="folder of the golden texts"
    )
    arguments = parser.parse_args()
    chosen = arguments.only or (list(FAST) if arguments.fast else list(parts))
    if not DATA.is_dir() and set(chosen) & GROUPS.keys():
        print(
            f"guard: no recordings at {DATA}, so none is judged; set DAQSVC_DATA to where they are",
            file=sys.stderr,
        )
        chosen = [name for name in chosen if name not in GROUPS]
    found: dict[str, str] = {}
    # Two at a time, each in a process of its own: it sets the current folder and the environment, and what
    # reads recordings stays in the folder that it was started in.
    with ProcessPoolExecutor(2, multiprocessing.get_context("spawn"), max_tasks_per_child=1) as pool:
        for name, texts, took_s in pool.map(run, sorted(chosen, key=parts.index)):
            found |= texts
            print(f"guard: {name}: {took_s:.0f} s", file=sys.stderr)
    differ = {name: diff for name, text in found.items() if (diff := compare(name, text, arguments.golden))}
    for name, diff in differ.items():
        print(diff, end="\n\n")
        if told := differences(_group(name)):
            print(f"key by key, against what was taken on this machine:\n{told}\n")
    if arguments.take:
        take(found, arguments.golden)
        for name in found:
            keep_taken(_group(name))
        if set(chosen) >= GROUPS.keys():
            TAKEN_ON.write_text(processor() + "\n", encoding="utf-8")
        if set(chosen) == set(parts):
            for path in unwanted(set(found), arguments.golden):
                path.unlink()
        print(f"guard: {len(found)} golden texts were taken, {len(differ)} of them new or other than before")
        return 0
    if differ:
        print(
            f"guard: {', '.join(differ)}: not as before. If that is meant: {TAKE}, "
            "and commit tests/guard/golden"
        )
        return 1
    print(f"guard: {len(found)} texts are as before")
    return 0


if __name__ == "__main__":
    _restarted()
    raise SystemExit(main())
