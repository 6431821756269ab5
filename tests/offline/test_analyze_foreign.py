"""What ``daqsvc analyze`` says of a recording is the same in every format, and its units are the file's."""

from __future__ import annotations

import numpy as np
import pytest
from support.foreign_files import WRITERS
from support.race_signals import RATE_HZ, SPEED_RPM, strikes

pytestmark = pytest.mark.integration
OPTIONS = ("--speed-rpm", SPEED_RPM, "--bearing", "6205-2RS")


def figures(found):
    """What is found, without the name of the file."""
    return {key: value for key, value in found.items() if key != "recording"}


def test_every_format_gives_the_same_verdict(analyze, tmp_path):
    signal = strikes("inner").astype(np.float32)
    reference = tmp_path / "run.npz"
    np.savez(reference, de=signal, fs=RATE_HZ)
    _, (expected,), _ = analyze(reference, "--channels", "de", *OPTIONS)
    assert expected["verdict"] == "inner"
    for ending, write in WRITERS.items():
        path = tmp_path / f"run{ending}"
        write(path, {"de": signal}, RATE_HZ, "g")
        code, (found,), _ = analyze(path, "--channels", "de", *OPTIONS)
        assert code == 0, ending
        if ending != ".mf4":  # whose times tell the rate to some digits only
            assert figures(found) == figures(expected), ending
        assert found["verdict"] == "inner", ending


def test_a_unit_that_contradicts_the_file_is_refused(analyze, tmp_path):
    path = tmp_path / "run.tdms"
    WRITERS[".tdms"](path, {"de": 9.80665 * strikes("inner")}, RATE_HZ, "m/s^2")
    code, (found,), _ = analyze(path, "--channels", "de", *OPTIONS)
    assert (code, found["verdict"]) == (3, None)
    assert "de of " in found["refused"]
    assert "is in m/s^2 by the file and in g as it would be read: say the file's unit" in found["refused"]
    code, (found,), _ = analyze(path, "--channels", "de", *OPTIONS, "--unit", "m/s2")
    assert (code, found["verdict"]) == (0, "inner")
