"""What ``daqsvc analyze`` says of a recording is the same in every format, and its units are the file's."""

from __future__ import annotations

import numpy as np
import pytest
from support.foreign_files import WRITERS
from support.orbit_files import OPTIONS as ORBIT_OPTIONS
from support.orbit_files import RATE_HZ as ORBIT_HZ
from support.orbit_files import Orbit
from support.paths import ROOT
from support.race_signals import RATE_HZ, SPEED_RPM, strikes
from support.snapshot_files import Sampled, write_snapshot

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
    assert "is in m/s^2 by the file, and would be read in g; state the file's unit" in found["refused"]
    code, (found,), _ = analyze(path, "--channels", "de", *OPTIONS, "--unit", "m/s2")
    assert (code, found["verdict"]) == (0, "inner")


def test_a_snapshot_that_is_damaged_or_cut_is_called_so(analyze, tmp_path):
    """By the options as by a machine file, and as `daqsvc export` and `replay` say it."""
    whole = Orbit(20)
    samples = np.column_stack([whole.x, whole.y, whole.keyphasor])
    units = {"probe-x": "um", "probe-y": "um", "keyphasor": "V"}
    path = write_snapshot(tmp_path / "run.mcap", {"shaft": Sampled(ORBIT_HZ, units, samples)}, 10**18)
    data = path.read_bytes()
    path.write_bytes(data[: data.rindex(b"\x0f\x04" + bytes(7))])
    machine = tmp_path / "machine.toml"
    text = (ROOT / "config" / "machines" / "rotor-synchronous.toml").read_text()
    machine.write_text(text.replace("rate_hz = 1600.0", f"rate_hz = {ORBIT_HZ}"))
    cut = "the snapshot ends early: it was cut, or is still being written"
    options = ["probe-x,probe-y" if one == "x,y" else one for one in ORBIT_OPTIONS]
    for known in ((machine, path), (path, *options)):
        _, (found,), _ = analyze(*known)
        assert cut in found["data_quality"]["problems"]


def test_a_snapshot_of_several_rates_says_which_is_read(analyze, tmp_path):
    samples = np.ones((640, 2))
    streams = {
        "fast": Sampled(3200.0, {"probe-x": "um", "keyphasor": "V"}, samples),
        "slow": Sampled(1600.0, {"probe-y": "um"}, samples[:320, :1]),
    }
    path = write_snapshot(tmp_path / "run.mcap", streams, 10**18)
    _, (found,), _ = analyze(ROOT / "config" / "machines" / "rotor-synchronous.toml", path)
    assert found["refused"] == (
        f"probe-y of {path} is sampled at 1600 Hz, and the fastest streams are read, at 3200 Hz; daqsvc "
        "replay judges all of them"
    )
