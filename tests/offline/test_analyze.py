"""``daqsvc analyze`` as a person or a script calls it."""

from __future__ import annotations

import math
import re
import subprocess
import sys
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from support.orbit_files import OPTIONS, RATE_HZ, SPEED_RPM, UNBALANCE, VERDICTS, Orbit

from daqsvc.cli import main

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

pytestmark = pytest.mark.integration
ROSS = (
    *("--probes", "x_disc,y_disc", "--unit", "m", "--natural-frequency-hz", "85", "--damping-ratio", "0.17"),
    *("--clearance-um", "342"),
)


def test_a_growing_unbalance_is_found_and_placed(analyze: Callable[..., Any], tmp_path: Path) -> None:
    file = Orbit(change=UNBALANCE).save(tmp_path / "grown.npz")
    code, (found,), err = analyze(file, *OPTIONS)
    assert (code, err) == (0, "")
    assert found["recording"] == str(file)
    assert found["verdict"] == "unbalance"
    assert set(found["group"]) <= {"unbalance", "damping_loss"}
    assert found["named"] is True
    # Which sample a mark falls on is up to the rounding of the stated speed.
    onset, departure = found["onset"], found["departure"]
    assert onset["sample"] in {80 * 64, 80 * 64 + 1}
    assert onset == {"sample": onset["sample"], "seconds": onset["sample"] / RATE_HZ, "revolution": 80}
    assert departure["revolution"] == 81
    assert departure["sample"] in {81 * 64, 81 * 64 + 1}
    assert 81 < found["declaration"]["revolution"] <= 100
    assert set(found["probabilities"]) == VERDICTS
    assert math.isclose(sum(found["probabilities"].values()), 1.0, abs_tol=1e-9)
    assert found["probabilities"]["normal"] < 1e-6
    assert found["evidence"]["unbalance"] > 100.0
    assert found["severity"] == pytest.approx(UNBALANCE, rel=0.05)
    real, imaginary = found["change_um"]["1"]
    assert math.hypot(real, imaginary) == pytest.approx(UNBALANCE * 40.0, rel=0.05)
    assert found["level"]["unbalance"]["ratio"] == pytest.approx(1.0 + UNBALANCE, rel=0.02)
    assert math.degrees(math.atan2(imaginary, real)) == pytest.approx(math.degrees(-0.7), abs=3.0)
    assert found["calibration"]["amplitude_um"] == pytest.approx(40.0, rel=0.01)
    assert found["calibration"]["noise_um"] == pytest.approx(1.0, rel=0.1)
    assert found["calibration"]["revolutions"] == 50
    assert found["speed_rpm"] == pytest.approx(SPEED_RPM)
    assert found["revolutions"] in {119, 120}
    assert found["history"][0] == {"revolution": 81, "verdict": None, "group": [], "named": False}
    assert found["history"][-1]["named"] is True
    assert found["refused"] is None
    assert found["data_quality"]["problems"] == []


def test_a_healthy_machine_is_normal(analyze: Callable[..., Any], tmp_path: Path) -> None:
    code, (found,), _ = analyze(Orbit().save(tmp_path / "healthy.npz"), *OPTIONS)
    assert code == 0
    assert (found["verdict"], found["group"], found["named"]) == ("normal", ["normal"], True)
    assert found["onset"] is found["departure"] is found["declaration"] is None
    assert found["probabilities"]["normal"] > 0.99
    assert found["history"] == []
    assert found["threshold_nats"] == pytest.approx(21.1, abs=0.1)


def test_a_recording_that_ends_before_the_name_says_what_it_may_be(
    analyze: Callable[..., Any], tmp_path: Path
) -> None:
    code, (found,), _ = analyze(Orbit(84, change=UNBALANCE).save(tmp_path / "short.npz"), *OPTIONS)
    assert code == 0
    assert found["departure"]["revolution"] == 81
    assert found["named"] is False
    assert found["declaration"] is None
    assert "unbalance" in found["group"]
    assert found["verdict"] == found["group"][0]


def test_a_fault_below_the_least_severity_gets_no_name(analyze: Callable[..., Any], tmp_path: Path) -> None:
    code, (found,), _ = analyze(Orbit(220, change=0.03).save(tmp_path / "small.npz"), *OPTIONS)
    assert code == 0
    assert (found["verdict"], found["group"]) == ("small_change", ["small_change"])


def test_a_keyphasor_decides_the_speed(analyze: Callable[..., Any], tmp_path: Path) -> None:
    file = Orbit(change=UNBALANCE).save(tmp_path / "key.npz")
    options = [*OPTIONS[:2], *OPTIONS[4:], "--keyphasor", "keyphasor"]
    code, (found,), _ = analyze(file, *options)
    assert code == 0
    assert found["verdict"] == "unbalance"
    assert found["speed_rpm"] == pytest.approx(SPEED_RPM, rel=1e-4)
    assert found["data_quality"]["keyphasor"] == {"accepted": 120, "missing": 0, "rejected": 0} | {
        "accepted": found["data_quality"]["keyphasor"]["accepted"]
    }
    assert 116 <= found["data_quality"]["keyphasor"]["accepted"] <= 120
    code, (found,), _ = analyze(file, *options, "--keyphasor-threshold", "3")
    assert code == 3
    assert "0 pulses cross 3; the channel lies between -10 and -2" in found["refused"]
    for stated_rpm, off in ((1500, True), (SPEED_RPM * 1.026, True), (SPEED_RPM * 1.01, False)):
        code, (found,), _ = analyze(file, *options, "--speed-rpm", stated_rpm)
        assert code == 0
        assert ("the keyphasor decides" in " ".join(found["data_quality"]["problems"])) == off


def test_a_shaft_that_turns_clockwise_has_a_negative_speed(
    analyze: Callable[..., Any], tmp_path: Path
) -> None:
    orbit = Orbit(change=UNBALANCE)
    orbit.x = -orbit.x
    options = [*OPTIONS[:2], *OPTIONS[4:]]
    code, (found,), _ = analyze(orbit.save(tmp_path / "cw.npz"), *options, "--speed-rpm", -SPEED_RPM)
    assert code == 0
    assert found["verdict"] == "unbalance"
    assert found["speed_rpm"] == pytest.approx(-SPEED_RPM)


def test_the_orbit_itself_can_tell_the_speed(analyze: Callable[..., Any], tmp_path: Path) -> None:
    options = [*OPTIONS[:2], *OPTIONS[4:]]
    code, (found,), _ = analyze(
        Orbit().save(tmp_path / "h.npz"), *options, "--speed-rpm", f"orbit:{1.01 * SPEED_RPM}"
    )
    assert code == 0
    assert found["verdict"] == "normal"
    assert found["speed_rpm"] == pytest.approx(SPEED_RPM, rel=1e-3)


@pytest.mark.long
def test_many_recordings_come_out_in_order_whatever_becomes_of_each(
    analyze: Callable[..., Any], tmp_path: Path
) -> None:
    long = Orbit(400, change=UNBALANCE).save(tmp_path / "long.npz")
    absent = tmp_path / "absent.npz"
    torn = tmp_path / "torn.npz"
    torn.write_bytes(long.read_bytes()[:5000])
    healthy = Orbit().save(tmp_path / "healthy.npz")
    files = [long, absent, healthy, torn, healthy]
    code, found, err = analyze(*files, *OPTIONS, "--jobs", 2)
    assert (code, err) == (3, "")
    assert [one["recording"] for one in found] == [str(file) for file in files]
    assert [one["verdict"] for one in found] == ["unbalance", None, "normal", None, "normal"]
    assert "there is no such file" in found[1]["refused"]
    assert str(torn) in found[3]["refused"]
    assert found[2] == found[4]
    alone = analyze(*files, *OPTIONS, "--jobs", 1)
    assert alone == (code, found, err)


def test_a_person_reads_what_and_since_when(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = Orbit(change=UNBALANCE).save(tmp_path / "grown.npz")
    assert main(["analyze", str(file), *OPTIONS]) == 0
    out, err = capsys.readouterr()
    assert err == ""
    lines = out.splitlines()
    assert lines[0].startswith(f"{file}: unbalance")
    assert re.search(
        r"changed at revolution 80 \(sample 512[01], 1\.600 s\); alarm at revolution 81 \(sample", lines[1]
    )
    assert any(line.startswith("  unbalance: ratio 1.8, change 32 um") for line in lines)
    assert len(lines) <= 8


@pytest.mark.long
def test_figures_are_drawn_for_each_recording(analyze: Callable[..., Any], tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    other = tmp_path / "other"
    other.mkdir()
    files = [
        Orbit(change=UNBALANCE).save(tmp_path / "a.npz"),
        Orbit(60).save(other / "a.npz"),
        Orbit(10).save(tmp_path / "short.npz"),
    ]
    code, _, _ = analyze(*files, *OPTIONS, "--plot", tmp_path / "new" / "figures")
    assert code == 3
    drawn = sorted(path.name for path in (tmp_path / "new" / "figures").iterdir())
    kinds = ("innovations", "orbit", "phase-plane", "poincare", "polar", "probabilities")
    assert drawn == sorted(f"{stem}-{kind}.png" for stem in ("a", "a-2") for kind in kinds)
    for name in drawn:
        assert (tmp_path / "new" / "figures" / name).read_bytes().startswith(b"\x89PNG")


def test_the_start_is_quick(tmp_path: Path) -> None:
    """Neither the kernels' compiler nor the figures are loaded where nobody asks for them."""
    file = Orbit(60).save(tmp_path / "a.npz")
    script = (
        "import sys; from daqsvc.cli import main; code = main(sys.argv[1:]); "
        "print(code, [name for name in ('numba', 'matplotlib', 'scipy.signal', 'rich', 'can') "
        "if name in sys.modules])"
    )
    done = subprocess.run(
        [sys.executable, "-c", script, "analyze", str(file), *OPTIONS, "--json"],
        capture_output=True,
        text=True,
        timeout=60,
        check=True,
    )
    assert done.stdout.splitlines()[-1] == "0 []"


@pytest.mark.long
@pytest.mark.data
@pytest.mark.parametrize(
    ("name", "rpm", "group"),
    [
        ("A07_healthy_G2p5", 3577.6767767857373, {"normal"}),
        ("A07_unb_x2_G2p5", 3577.6767767857373, {"unbalance"}),
        ("A1_damp_L2", 5110.966823972328, {"damping_loss"}),
        ("A1_healthy_G2p5", 5110.966823972328, {"normal"}),
        ("A1_healthy_e0p1", 5110.966823972328, {"normal"}),
        ("A1_misalign", 5110.966823972328, {"unmodelled"}),
        ("A1_rub_1", 5110.966823979626, {"rub"}),
        ("A1_static_l0p1", 5110.966823972328, {"static_load"}),
        ("A1_stiff_k0p75", 5110.966823972328, {"stiffness_loss"}),
        ("A1_unb_x2_G2p5", 5110.966823972328, {"unbalance"}),
    ],
)
def test_finite_element_rotors_at_20_db(
    name: str, rpm: float, group: set[str], analyze: Callable[..., Any], data: Path, tmp_path: Path
) -> None:
    files = []
    with np.load(data / "ross" / f"{name}.npz") as clean:
        onset = int(clean["onset"][0]) if len(clean["onset"]) else len(clean["x_disc"])
        for seed in (1, 2):
            rng = np.random.default_rng(seed)
            noisy = {
                probe: clean[probe]
                + 0.1 * clean[probe][:onset].std() * rng.standard_normal(len(clean[probe]))
                for probe in ("x_disc", "y_disc")
            }
            files.append(tmp_path / f"{seed}.npz")
            np.savez(files[-1], fs=clean["fs"], **noisy)
    code, found, _ = analyze(*files, *ROSS, "--speed-rpm", repr(rpm))
    assert code == 0
    for one in found:
        assert group <= set(one["group"])
        assert set(one["group"]) <= group | {"unbalance", "damping_loss"}
        if group != {"normal"}:
            assert one["onset"]["revolution"] == pytest.approx(70, abs=1)
            assert one["departure"]["revolution"] <= 73


def test_options_may_stand_between_recordings(
    analyze: Callable[..., Any], capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    files = [Orbit(seed=seed).save(tmp_path / f"{seed}.npz") for seed in (1, 2, 3)]
    code, found, err = analyze(files[0], *OPTIONS, files[1], "--jobs", "1", files[2])
    assert (code, err) == (0, "")
    assert [one["recording"] for one in found] == [str(file) for file in files]
    code, _, err = analyze(files[0], *OPTIONS, files[1], "--no-such-option")
    assert code == 2
    assert "unrecognized arguments" in err
    assert "--no-such-option" in err
    with pytest.raises(SystemExit):
        main(["example", "one", "two.toml"])
    assert "unrecognized arguments: two.toml" in capsys.readouterr().err


def test_a_map_of_no_channel_is_refused(analyze: Callable[..., Any], tmp_path: Path) -> None:
    file = Orbit().save(tmp_path / "a.npz")
    code, found, err = analyze(file, *OPTIONS, "--map", "z=x")
    assert (code, found) == (2, [])
    assert "--map names 'z', which --probes and --keyphasor do not; they name x, y" in err
    code, (one,), _ = analyze(file, *OPTIONS, "--map", "x=y,y=x")
    assert "turns against" in one["refused"]
