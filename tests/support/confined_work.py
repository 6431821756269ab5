"""What a confined process is asked to do in tests: its work, more than its share, or its own end."""

from __future__ import annotations

import ctypes
import os
import sys

import numpy as np


def double(numbers):
    return {"pid": os.getpid()}, [2.0 * np.asarray(numbers), np.empty((0, 3))]


def chatter():
    sys.stdout.write("x" * 10_000)
    sys.stderr.write("y" * 10_000)
    return "said", []


def take_memory(count):
    return float(np.ones(count).sum()), []


def spin():
    while True:
        pass


def crash():
    ctypes.string_at(0)


def leave():
    os._exit(7)


def fail():
    raise KeyError("no such thing")


def grow(rows):
    # What JSON says is little, what is announced is much.
    return None, [np.zeros(1)] * rows


def spin_with(**_):
    spin()
