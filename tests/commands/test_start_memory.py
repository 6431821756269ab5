"""Memory that only the start needs is given back."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import numpy as np

from daqsvc.commands.start_memory import give_back, unchanged

SMAPS = """\
1000-3000 r-xp 00001000 fd:01 77 /usr/lib/libllvmlite.so
Rss:                   8 kB
Anonymous:             0 kB
Swap:                  0 kB
3000-4000 r--p 00003000 fd:01 77 /usr/lib/libllvmlite.so
Rss:                   4 kB
Anonymous:             4 kB
4000-5000 rw-p 00004000 fd:01 77 /usr/lib/libllvmlite.so
Rss:                   4 kB
Anonymous:             0 kB
4000-5000 r--p 00004000 fd:01 77 /usr/lib/libllvmlite.so
Rss:                   0 kB
Anonymous:             0 kB
Swap:                  4 kB
5000-9000 r--p 00000000 fd:01 78 /usr/lib/libc.so.6
Rss:                  12 kB
Anonymous:             0 kB
9000-a000 r--s 00000000 fd:01 79 /data/run-up.npy
Rss:                   4 kB
Anonymous:             0 kB
a000-b000 r-xp 00000000 00:00 0 
Rss:                   4 kB
Anonymous:             0 kB
ffffffffff600000-ffffffffff601000 --xp 00000000 00:00 0                  [vsyscall]
Anonymous:             0 kB
"""  # noqa: W291 - the kernel writes it so


def test_only_parts_of_libraries_are_let_go_that_are_as_in_the_file() -> None:
    assert list(unchanged(SMAPS.splitlines())) == [(0x1000, 0x2000), (0x5000, 0x4000)]


def resident_kb() -> int:
    """What of the libraries of this process is in memory and as in the file."""
    text = Path("/proc/self/smaps").read_text()
    parts = {first for first, _ in unchanged(text.splitlines())}
    found = re.findall(r"(?ms)^([0-9a-f]+)-.*?^Rss: +(\d+) kB", text)
    return sum(int(size) for first, size in found if int(first, 16) in parts)


def test_what_was_let_go_comes_back_when_it_is_needed() -> None:
    matrix = np.random.default_rng(0).normal(size=(50, 50))
    inverse = np.linalg.inv(matrix)
    before = resident_kb()
    give_back()
    assert resident_kb() < before / 2
    np.testing.assert_array_equal(np.linalg.inv(matrix), inverse)


HEAPS = """
import ctypes, sys, threading
from daqsvc.commands.start_memory import share_heaps
if sys.argv[1:]:
    share_heaps()
libc = ctypes.CDLL(None)
libc.malloc.restype = ctypes.c_void_p
there = threading.Barrier(12)
def use():
    libc.malloc(1000)
    there.wait()
threads = [threading.Thread(target=use) for _ in range(12)]
for thread in threads: thread.start()
for thread in threads: thread.join()
libc.malloc_stats()
"""


def test_threads_share_two_heaps() -> None:
    def heaps(*arguments: str) -> int:
        command = [sys.executable, "-c", HEAPS, *arguments]
        return subprocess.run(command, capture_output=True, text=True, check=True).stderr.count("Arena ")

    assert heaps("share") <= 2 < heaps()
