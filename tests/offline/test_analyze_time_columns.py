"""A recording's own times decide: neither another rate nor missing rows make a machine healthy."""

from __future__ import annotations

import numpy as np
import pytest
from support.race_signals import RATE_HZ, SPEED_RPM, strikes

pytestmark = pytest.mark.integration
OPTIONS = ("--channels", "de", "--speed-rpm", SPEED_RPM, "--bearing", "6205-2RS")


def save(path, rows):
    """A damaged inner race with the times of its samples, without some of its rows."""
    signal = strikes("inner")
    t = np.arange(len(signal)) / RATE_HZ
    table = np.column_stack([t, signal])[rows]
    np.savetxt(path, table, fmt=("%.6f", "%.5g"), delimiter=",", header="time,de", comments="")
    return path


def test_another_rate_is_refused(analyze, tmp_path):
    path = save(tmp_path / "run.csv", slice(None))
    code, (found,), _ = analyze(path, *OPTIONS)
    assert (code, found["verdict"]) == (0, "inner")
    code, (found,), _ = analyze(path, *OPTIONS, "--fs", 48_000)
    assert (code, found["verdict"]) == (3, None)
    assert (
        "is 12000 Hz (time column 'time', read as seconds) by the file and 48000 Hz as given"
        in found["refused"]
    )


@pytest.mark.parametrize("lost", [0.02, 0.1, 0.3])
def test_missing_rows_are_gaps(analyze, tmp_path, lost):
    """Frames of ten samples are lost at random; joined, the rest would have no lines at all."""
    kept = np.repeat(np.random.default_rng(4).random(len(strikes("inner")) // 10) >= lost, 10)
    code, (found,), _ = analyze(save(tmp_path / "run.csv", kept), *OPTIONS)
    assert found["verdict"] != "normal"
    assert (code == 3) == (found["refused"] is not None)
    if found["refused"] is None:
        assert found["verdict"] == "inner"
        missing = found["data_quality"]["missing"]["de"]
        assert missing == pytest.approx(lost * len(kept), rel=0.1)


def test_stamps_that_go_back_do_not_let_another_rate_in(analyze, tmp_path):
    rows = np.arange(len(strikes("inner")))
    path = save(tmp_path / "run.csv", rows)
    lines = path.read_text().splitlines(keepends=True)
    stamps = [line.partition(",")[0] for line in lines]
    stamps[5001:5011] = stamps[5001:5011][::-1]
    path.write_text("".join(f"{t},{line.partition(',')[2]}" for t, line in zip(stamps, lines, strict=True)))
    code, (found,), _ = analyze(path, *OPTIONS, "--fs", 48_000)
    assert (code, found["verdict"]) == (3, None)
    assert "by the file and 48000 Hz as given" in found["refused"]
    for given in ((), ("--fs", RATE_HZ)):
        code, (found,), _ = analyze(path, *OPTIONS, *given)
        assert (code, found["verdict"]) == (0, "inner")
        assert any(
            "time column 'time' goes back in 9 steps" in one for one in found["data_quality"]["problems"]
        )
