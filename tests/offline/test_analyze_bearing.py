"""``daqsvc analyze`` and ``calibrate`` for bearings, as a person or a script calls them."""

from __future__ import annotations

import json
import math
import subprocess
import sys
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from support.bearing_signals import BALL, INNER, OPTIONS, OUTER, RATE_HZ, Housing, healthy
from support.given_codes import had
from support.orbit_files import SPEED_RPM, Orbit
from support.paths import ROOT

from daqsvc.cli import main

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    Run = Callable[..., tuple[int, list[dict[str, Any]], str]]

pytestmark = pytest.mark.integration
EXAMPLE = ROOT / "config" / "machines" / "bearing.toml"
WORDS = {"normal", "changed", "inner", "outer", "ball", "inner_or_outer"}

SIZE = ("--balls", "9", "--ball-diameter-mm", "7.94", "--pitch-diameter-mm", "39.04")


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Recordings of one machine: healthy twice, then with each part damaged."""
    folder = tmp_path_factory.mktemp("bearing")
    return {
        "baseline": Housing(seed=1).save(folder / "baseline.npz"),
        "healthy": Housing(seed=2).save(folder / "healthy.npz"),
        "inner": Housing(order=INNER, seed=3).save(folder / "inner.npz"),
        "outer": Housing(order=OUTER, seed=4).save(folder / "outer.npz"),
        "ball": Housing(order=BALL, seed=5).save(folder / "ball.npz"),
    }


@pytest.mark.parametrize("part", ["inner", "outer"])
def test_the_damaged_race_is_named_with_its_lines(verb: Run, files: dict[str, Path], part: str) -> None:
    code, (found,), err = verb("analyze", files[part], *OPTIONS)
    assert (code, err) == (0, "")
    assert found["recording"] == str(files[part])
    assert (found["verdict"], found["group"], found["channel"]) == (part, [part], "de")
    assert set(found["probabilities"]) == WORDS
    assert math.isclose(sum(found["probabilities"].values()), 1.0, abs_tol=1e-9)
    assert max(found["probabilities"], key=found["probabilities"].get) == part
    evidence = found["evidence"]
    assert set(evidence) == {"inner", "outer", "ball"}
    assert evidence[part]["z"] > evidence[part]["z_limit"]
    assert evidence[part]["severity"] > evidence[part]["severity_limit"]
    assert max(evidence, key=lambda name: evidence[name]["severity"]) == part
    assert found["severity"] == evidence[part]["severity"]
    order = {"inner": INNER, "outer": OUTER}[part]
    first = next(line for line in found["lines"] if line["part"] == part and line["sideband"] == 0)
    assert first["order"] == pytest.approx(first["harmonic"] * order, rel=0.015)
    assert first["frequency_hz"] == pytest.approx(first["order"] * found["speed_rpm"] / 60.0, rel=1e-6)
    assert found["speed_rpm"] == pytest.approx(1797.0, rel=2e-3)
    assert found["speed_seen"] is True
    assert found["revolutions"] == pytest.approx(299.5, rel=2e-3)
    assert found["baseline"] is None
    assert found["residual"] is None
    assert found["refused"] is None
    assert 0.0 < found["race_false_alarm_probability"] < 0.05
    assert found["channels"]["de"]["bearing"]["name"] == "6205-2RS"
    assert found["channels"]["de"]["bearing"]["bpfi"] == pytest.approx(INNER, rel=1e-3)


@pytest.mark.parametrize("part", ["healthy", "inner"])
def test_a_stated_speed_that_the_harmonics_show_to_be_wrong_is_noted(
    verb: Run, files: dict[str, Path], part: str
) -> None:
    for stated_rpm, off in (
        (1750.3, "+2.7"),
        (1785.0, None),
        (1797.0, None),
        (1810.0, None),
        (1843.7, "-2.5"),
    ):
        code, (found,), _ = verb("analyze", files[part], *OPTIONS, "--speed-rpm", stated_rpm)
        assert (code, found["verdict"]) == (0, "normal" if part == "healthy" else part)
        noted = [one for one in found["data_quality"]["problems"] if "harmonics of the shaft" in one]
        note = (
            f"the harmonics of the shaft stand out at 1797.0 rpm, not at the stated {stated_rpm} rpm "
            f"({off} %): the former is used; correct the speed"
        )
        assert noted == ([note] if off else [])


@pytest.mark.long
@pytest.mark.parametrize("part", ["normal", "inner"])
def test_what_is_too_long_to_be_judged_at_one_go_is_watched(
    verb: Run, tmp_path: Path, files: dict[str, Path], monkeypatch: pytest.MonkeyPatch, part: str
) -> None:
    monkeypatch.setattr("daqsvc.detectors.bearing.recorded.MOST_AT_ONCE", 1000)
    monkeypatch.setattr("daqsvc.detectors.bearing.recorded.analyse_bearings", None)
    housing = Housing(seed=6) if part == "normal" else Housing(order=INNER, seed=6)
    recording = replace(housing, seconds=40.0).save(tmp_path / "long.npz")
    for baseline in ((), ("--baseline", files["baseline"])):
        code, (found,), err = verb("analyze", recording, *OPTIONS, *baseline, "--jobs", 1)
        assert (code, err) == (0, "")
        assert (found["verdict"], found["group"]) == (part, [part])
        assert found["speed_rpm"] == pytest.approx(1797.0, rel=2e-3)
        assert found["data_quality"]["samples"] == 40 * RATE_HZ
        if baseline:
            assert (found["baseline"], found["residual"] is not None) == (str(files["baseline"]), True)


def test_without_a_healthy_run_a_healthy_machine_is_normal(verb: Run, files: dict[str, Path]) -> None:
    code, (found,), _ = verb("analyze", files["healthy"], *OPTIONS)
    assert (code, found["verdict"], found["group"]) == (0, "normal", ["normal"])
    assert found["probabilities"]["normal"] > 0.5


@pytest.mark.long
def test_many_recordings_come_in_order_from_any_number_of_processes(
    verb: Run, files: dict[str, Path]
) -> None:
    names = ["outer", "healthy", "inner", "baseline"]
    call = (*(files[name] for name in names), *OPTIONS, "--baseline", files["baseline"])
    code, alone, _ = verb("analyze", *call, "--jobs", 1)
    assert code == 0
    assert [found["recording"] for found in alone] == [str(files[name]) for name in names]
    assert [found["verdict"] for found in alone] == ["outer", "normal", "inner", "normal"]
    code, shared, _ = verb("analyze", *call, "--jobs", 2)
    assert (code, shared) == (0, alone)


def test_a_healthy_run_tells_a_change_of_unknown_cause(
    verb: Run, files: dict[str, Path], tmp_path: Path
) -> None:
    noisy = healthy(10.0, 6)
    hiss = np.random.default_rng(7).standard_normal(len(noisy) + 8)
    noisy += 0.1 * np.convolve(hiss, [1.0, -1.0, 1.0, -1.0], mode="same")[: len(noisy)]
    np.savez(tmp_path / "dry.npz", de=noisy)
    call = ("analyze", tmp_path / "dry.npz", *OPTIONS)
    _, (blind,), _ = verb(*call)
    assert blind["verdict"] == "normal"
    code, (found,), _ = verb(*call, "--baseline", files["baseline"], "--false-alarm-probability", "1e-4")
    assert (code, found["verdict"], found["group"]) == (0, "changed", ["changed"])
    assert found["probabilities"]["changed"] > 0.5
    assert found["baseline"] == str(files["baseline"])
    assert found["false_alarm_probability"] == 1e-4
    residual = found["residual"]
    assert residual["changed"] is True
    assert residual["departure"] > 1.0
    assert residual["ratio"] == pytest.approx(10.0 ** (residual["rise_db"] / 20.0))
    worst = max(residual["bands"], key=lambda band: band["rise_db"])
    assert worst["high_hz"] == pytest.approx(0.48 * RATE_HZ)
    assert worst["rise_db"] > worst["limit_db"]


def test_of_two_bearings_the_one_that_shows_more_is_the_damaged_one(verb: Run, tmp_path: Path) -> None:
    near = Housing(order=OUTER, seed=8).samples
    far = healthy(10.0, 9) + 0.3 * (near - healthy(10.0, 8))
    np.savez(tmp_path / "two.npz", fe=far, de=near)
    np.savez(tmp_path / "good.npz", fe=healthy(10.0, 10), de=healthy(10.0, 11))
    options = ("--channels", "fe,de", *OPTIONS[2:])
    code, (found,), _ = verb("analyze", tmp_path / "two.npz", *options, "--baseline", tmp_path / "good.npz")
    assert (code, found["verdict"], found["channel"]) == (0, "outer", "de")
    assert found["channels"]["de"]["severity"] > found["channels"]["fe"]["severity"]
    assert found["severity"] == found["channels"]["de"]["severity"]
    assert found["residual"]["changed"] is True
    # One dead accelerometer does not silence the other; it is told.
    np.savez(tmp_path / "dead.npz", fe=np.full(120_000, 0.3), de=near)
    code, (found,), _ = verb("analyze", tmp_path / "dead.npz", *options, "--baseline", tmp_path / "good.npz")
    assert (code, found["verdict"]) == (0, "outer")
    assert found["channels"]["fe"]["verdict"] is None
    assert "dead" in found["channels"]["fe"]["refused"]


def test_orders_stand_in_for_the_catalogue(verb: Run, files: dict[str, Path]) -> None:
    orders = "FTF=0.3983,bpfi=5.4152,BPFO=3.5848,BSF=2.3567"
    code, (found,), _ = verb("analyze", files["outer"], *OPTIONS[:-2], "--orders", orders)
    assert (code, found["verdict"]) == (0, "outer")
    assert found["channels"]["de"]["bearing"] == {
        "name": None, "bpfi": 5.4152, "bpfo": 3.5848, "bsf": 2.3567, "ftf": 0.3983
    }  # fmt: skip


def test_dimensions_stand_in_for_the_catalogue(verb: Run, files: dict[str, Path]) -> None:
    code, (found,), _ = verb("analyze", files["outer"], *OPTIONS[:-2], *SIZE)
    assert (code, found["verdict"]) == (0, "outer")
    bearing = found["channels"]["de"]["bearing"]
    assert bearing.pop("name") is None
    assert bearing == pytest.approx({"bpfi": 5.4152, "bpfo": 3.5848, "bsf": 2.3567, "ftf": 0.3983}, rel=1e-3)


def test_variables_are_found_by_the_end_of_their_names(verb: Run, tmp_path: Path) -> None:
    """Sets of recordings number their variables, and one set of options must do for all."""
    first, second = Housing(order=OUTER, seed=12).samples, Housing(seed=13).samples
    np.savez(tmp_path / "a.npz", X105_DE_time=first, X105_FE_time=second)
    np.savez(tmp_path / "b.npz", X106_DE_time=second, X106_FE_time=second)
    np.savez(tmp_path / "c.npz", X097_DE_time=second, X098_DE_time=second)
    options = ("--channels", "DE_time", *OPTIONS[2:])
    code, found, _ = verb("analyze", *(tmp_path / f"{name}.npz" for name in "abc"), *options)
    assert code == 3
    assert [one["verdict"] for one in found] == ["outer", "normal", None]
    assert "several channels that may be 'DE_time': X097_DE_time, X098_DE_time" in found[2]["refused"]


def test_a_healthy_run_of_another_rate_and_name_is_used(
    verb: Run, files: dict[str, Path], tmp_path: Path
) -> None:
    np.savez(tmp_path / "fast.npz", other=Housing(seed=14, rate_hz=48_000.0).samples)
    call = ("analyze", files["outer"], *OPTIONS, "--baseline", tmp_path / "fast.npz", "--baseline-fs", 48_000)
    code, (found,), _ = verb(*call, "--baseline-map", "de=other")
    assert (code, found["verdict"]) == (0, "outer")
    assert found["residual"]["bands"][-1]["high_hz"] == pytest.approx(0.4 * RATE_HZ)
    code, _, err = verb(*call)
    assert code == 2
    assert "healthy run" in err
    assert "has no channel 'de'" in err


def damaged(kind: str) -> np.ndarray:
    """A recording of a damaged outer race that is itself damaged."""
    x = Housing(order=OUTER, seed=15).samples
    if kind == "dead":
        return np.full(len(x), 0.25)
    if kind == "clipped":
        return np.clip(x, -0.12, 0.12)
    if kind == "missing":
        x[1000:60_000] = np.nan
        return x
    if kind == "short":
        return x[:6000]
    raise AssertionError(kind)


@pytest.mark.parametrize(
    ("kind", "said"),
    [("dead", "dead"), ("clipped", "clipped"), ("missing", "NaN"), ("short", "too short")],
)
def test_what_cannot_be_judged_is_refused_by_name(verb: Run, tmp_path: Path, kind: str, said: str) -> None:
    np.savez(tmp_path / "bad.npz", de=damaged(kind))
    code, (found,), _ = verb("analyze", tmp_path / "bad.npz", *OPTIONS)
    assert code == 3
    assert (found["verdict"], found["group"], found["lines"]) == (None, [], [])
    assert found["refused"].startswith("de: ")
    assert said in found["refused"]
    assert found["code"] == "R14"
    had("R14", found["refused"])
    assert found["data_quality"]["samples"] == len(damaged(kind))


def test_offsets_and_moving_zeros_and_impossible_sizes_are_told(verb: Run, tmp_path: Path) -> None:
    x = Housing(order=OUTER, seed=16).samples
    for name, samples in (
        ("offset", x + 50.0),
        ("moving", x + np.linspace(0.0, 9.0, len(x))),
        ("size", 1e5 * x),
    ):
        np.savez(tmp_path / f"{name}.npz", de=samples)
    paths = [tmp_path / f"{name}.npz" for name in ("offset", "moving", "size")]
    code, found, _ = verb("analyze", *paths, *OPTIONS)
    assert code == 0
    assert [one["verdict"] for one in found] == ["outer"] * 3
    told = [[*one["notes"], *one["data_quality"]["problems"]] for one in found]
    for words, wanted in zip(told, ("offset of 50", "mean moves from", "the unit looks wrong"), strict=True):
        assert any(wanted in sentence for sentence in words), words


def test_another_unit_or_a_machine_at_rest_is_no_change_of_the_machine(
    verb: Run, files: dict[str, Path], tmp_path: Path
) -> None:
    x = Housing(seed=17).samples
    np.savez(tmp_path / "unit.npz", de=9.80665 * x)
    np.savez(tmp_path / "rest.npz", de=0.02 * x)
    call = (tmp_path / "unit.npz", tmp_path / "rest.npz", *OPTIONS, "--baseline", files["baseline"])
    code, found, _ = verb("analyze", *call)
    assert code == 3
    assert [one["verdict"] for one in found] == [None, None]
    assert all("unit" in one["refused"] for one in found)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (("--bearing", "6205", "--orders", "BPFI=5,BPFO=3,BSF=2,FTF=0.4"), "leave out one of them"),
        (("--bearing", "6205"), "--channels, --speed-rpm must be given too"),
        (("--balls", "9"), "--ball-diameter-mm, --pitch-diameter-mm must be given too"),
        (("--contact-deg", "15"), "--balls, --ball-diameter-mm"),
        ((*SIZE, "--bearing", "6205"), "leave out all but one of them"),
        ((*SIZE, "--contact-deg", "90", *OPTIONS[:6]), "contact angle is 90 deg"),
        (("--balls", "30", *SIZE[2:], *OPTIONS[:6]), "30 balls of diameter 7.94 do not fit"),
        (("--bearing", "6205-XX", "--channels", "de", "--speed-rpm", "1797"), "did you mean 6205?"),
        (
            ("--bearing", "99999", "--channels", "de", "--speed-rpm", "1797"),
            "BPFI=..,BPFO=..,BSF=..,FTF=.. [C02]",
        ),
        (
            ("--bearing", "22210", "--channels", "de", "--speed-rpm", "1797"),
            "a spherical roller bearing, is not in the catalogue; no name in it is near. Give --balls (or",
        ),
        (("--orders", "BPFI=5,BPFO=3,BSF=2"), "FTF missing"),
        (("--orders", "BPFI=5,BPFI=3,BSF=2,FTF=.4"), "'BPFI=3' is no fault order"),
        (("--orders", "BPFI=-5,BPFO=3,BSF=2,FTF=.4"), "'BPFI=-5' is no fault order"),
        (("--orders", "BPFI=9,BPFO=3,BSF=2,FTF=.4", *OPTIONS[:6]), "does not fit"),
        (("--bearing", "6205", "--channels", "a,b,c", "--speed-rpm", "1797"), "names 3 accelerometers"),
        (("--bearing", "6205", "--channels", "a", "--speed-rpm", "orbit:1797"), "needs two probes"),
        ((*OPTIONS, "--unit", "um"), "accelerometers measure"),
        ((*OPTIONS, "--probes", "x,y"), "--probes: not with"),
        ((*OPTIONS, "--baseline-fs", "9e3"), "no --baseline"),
        ((*OPTIONS, "--baseline", "no.npz"), "healthy run no.npz"),
    ],
)
def test_wrong_usage_is_told(verb: Run, files: dict[str, Path], options: tuple[str, ...], said: str) -> None:
    code, found, err = verb("analyze", files["outer"], *options)
    assert (code, found) == (2, [])
    assert said in err


def test_an_unsteady_healthy_run_is_refused(verb: Run, files: dict[str, Path], tmp_path: Path) -> None:
    x = Housing(seed=18).samples
    np.savez(tmp_path / "unsteady.npz", de=x * np.linspace(1.0, 1.7, len(x)))
    code, _, err = verb("analyze", files["outer"], *OPTIONS, "--baseline", tmp_path / "unsteady.npz")
    assert code == 2
    assert "the machine is not steady" in err


def test_figures_mark_the_lines(verb: Run, files: dict[str, Path], tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    code, _, _ = verb("analyze", files["outer"], *OPTIONS, "--plot", tmp_path / "figures")
    assert code == 0
    (figure,) = (tmp_path / "figures").iterdir()
    assert figure.name == "outer-envelope.png"
    assert figure.stat().st_size > 20_000


def test_the_words_for_a_person_say_the_same(files: dict[str, Path]) -> None:
    command = [
        sys.executable,
        "-m",
        "daqsvc",
        "analyze",
        files["inner"],
        *OPTIONS,
        "--baseline",
        files["baseline"],
    ]
    done = subprocess.run(list(map(str, command)), capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0
    lines = done.stdout.splitlines()
    assert lines[0].startswith(f"{files['inner']}: inner race at de, severity ")
    assert any("BPFI at 16" in line for line in lines)
    assert any("does not predict is" in line for line in lines)
    assert any("rpm by its harmonics" in line for line in lines)


def test_every_key_is_documented(verb: Run, files: dict[str, Path]) -> None:
    told = (ROOT / "docs" / "analyze.md").read_text()
    _, (found,), _ = verb("analyze", files["outer"], *OPTIONS, "--baseline", files["baseline"])
    channel = found["channels"]["de"]
    nested = (found["evidence"]["outer"], found["lines"][0], found["residual"], found["residual"]["bands"][0])
    for keys in (found, channel, channel["bearing"], *nested):
        assert [key for key in keys if f"`{key}`" not in told] == []
    assert [word for word in WORDS if f"`{word}`" not in told] == []


def test_a_machine_file_is_judged_by_the_live_detector(verb: Run, tmp_path: Path) -> None:
    text = EXAMPLE.read_text().replace("speed_rpm = 1772.0", "speed_rpm = 1797.0")
    (tmp_path / "m.toml").write_text(text)
    seconds = 20.0
    good = {"accel-de": healthy(seconds, 31), "accel-fe": healthy(seconds, 32)}
    bad = {**good, "accel-de": Housing(seconds, OUTER, seed=33).samples}
    np.savez(tmp_path / "good.npz", **good)
    np.savez(tmp_path / "bad.npz", **bad)
    np.savez(tmp_path / "shown.npz", **{"accel-fe": bad["accel-de"][:24_000]})
    recordings = [tmp_path / f"{name}.npz" for name in ("good", "bad", "shown")]
    code, found, _ = verb("analyze", tmp_path / "m.toml", *recordings, "--fs", 12_000)
    assert code == 0
    assert [one["verdict"] for one in found] == ["normal", "outer", "normal"]
    bad_one = found[1]
    assert bad_one["channel"] == "drive-end"
    history = bad_one["detectors"]["bearing"]["history"]
    assert [step["decision"] for step in history] == ["undetermined", "outer"]
    assert history[-1]["seconds"] == pytest.approx(5.0)
    assert bad_one["detectors"]["bearing"]["sensors"] == ["accel-de"]
    assert any(name.startswith("levels/") for name in bad_one["detectors"])
    assert set(found[2]["channels"]) == {"fan-end"}
    left_out = f"drive-end: not judged, as the recording has no channel for accel-de of {tmp_path / 'm.toml'}"
    assert [left_out in one["data_quality"]["problems"] for one in found] == [False, False, True]


def test_a_person_reads_what_gives_the_verdict_once(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "m.toml").write_text(EXAMPLE.read_text().replace("speed_rpm = 1772.0", "speed_rpm = 1797.0"))
    samples = {"accel-de": Housing(10.0, OUTER, seed=33).samples, "accel-fe": healthy(10.0, 32)}
    np.savez(tmp_path / "bad.npz", **samples)
    recording = str(tmp_path / "bad.npz")
    assert main(["analyze", str(tmp_path / "m.toml"), recording, "--fs", "12000"]) == 0
    first, *lines = capsys.readouterr().out.splitlines()
    assert first.startswith(f"{recording}: outer race at drive-end, severity ")
    # All the other detectors see nothing wrong.
    assert [line.split(":")[0].strip() for line in lines[-2:]] == ["levels/accel-de", "levels/accel-fe"]
    assert not [line for line in lines if "worst of" in line or line.strip().startswith("bearing:")]


def test_what_calibrate_wrote_is_the_healthy_machine(verb: Run, tmp_path: Path) -> None:
    machine = tmp_path / "m.toml"
    machine.write_text(
        EXAMPLE.read_text()
        .replace("speed_rpm = 1772.0", "speed_rpm = 1797.0")
        .replace("rate_hz = 25_600.0", "rate_hz = 12_000.0")
    )
    samples = {"accel-de": healthy(10.0, 41), "accel-fe": healthy(10.0, 42)}
    np.savez(tmp_path / "good.npz", **samples)
    np.savez(tmp_path / "bad.npz", **{**samples, "accel-fe": Housing(order=OUTER, seed=43).samples})
    loud = {name: x + 0.1 * np.random.default_rng(44).standard_normal(len(x)) for name, x in samples.items()}
    np.savez(tmp_path / "loud.npz", **loud)
    out = tmp_path / "motor.toml"
    code, (made,), _ = verb("calibrate", machine, tmp_path / "good.npz", "--fs", 12_000, "--out", out)
    assert (code, made["refused"], made["written_to"]) == (0, None, str(out))
    assert [model["channels"] for model in made["models"]] == [["accel-de"], ["accel-fe"]]
    assert all(0 < model["spectral_radius"] < 1 for model in made["models"])
    call = ("analyze", machine, tmp_path / "loud.npz", "--fs", 12_000)
    assert verb(*call)[1][0]["verdict"] == "normal"
    code, (found,), _ = verb(*call, "--calibration", out)
    assert (code, found["verdict"]) == (0, "changed")
    # A rate that is not the calibration's is refused, recording by recording.
    code, (found,), _ = verb("analyze", machine, tmp_path / "loud.npz", "--fs", 10_000, "--calibration", out)
    assert code == 3
    assert "was learnt at 12000 Hz, and the samples to be judged come at 10000 Hz" in found["refused"]


@pytest.mark.long
def test_what_calibrate_wrote_by_options_is_read_by_options(verb: Run, tmp_path: Path) -> None:
    samples = {name: healthy(10.0, seed) for name, seed in (("de", 41), ("fe", 42))}
    loud = {name: x + 0.1 * np.random.default_rng(44).standard_normal(len(x)) for name, x in samples.items()}
    for name, content in (("good", samples), ("loud", loud)):
        np.savez(tmp_path / f"{name}.npz", **content)
    good, run, out = (tmp_path / name for name in ("good.npz", "loud.npz", "motor.toml"))
    both = ("--channels", "de,fe", *OPTIONS[2:])
    assert verb("calibrate", good, *both, "--out", out)[0] == 0
    assert verb("analyze", run, *both)[1][0]["verdict"] == "normal"
    for options in (both, OPTIONS):
        code, (against,), _ = verb("analyze", run, *options, "--baseline", good)
        assert (code, against["verdict"]) == (0, "changed")
        code, (found,), _ = verb("analyze", run, *options, "--calibration", out)
        assert (code, found) == (0, against)
    for option, value, said in (
        ("--channels", "fe,de", "holds nothing of fe and de together; calibrate with --channels fe,de"),
        ("--channels", "other", "has no channel 'other'"),
        (
            "--fs",
            "10000",
            "was learnt at 12000 Hz, and the samples to be judged come at 10000 Hz; calibrate at 10000 Hz",
        ),
        (
            "--unit",
            "m/s2",
            "was learnt at de in g, and the samples to be judged are in m/s2; calibrate in m/s2",
        ),
        ("--unit", "V", "was learnt at de in g, and the samples to be judged are in V"),
        (
            "--speed-rpm",
            "900",
            "was learnt at 1797 rpm, and the machine turns at 900 rpm; calibrate at 900 rpm",
        ),
        ("--bearing", "6203", "of another bearing (6205) than is watched there (6203 or ER10K"),
    ):
        code, (found,), _ = verb("analyze", run, *both, option, value, "--calibration", out)
        assert (code, found["verdict"]) == (3, None)
        assert said in found["refused"]


def test_a_calibration_says_what_it_is_for(verb: Run, files: dict[str, Path], tmp_path: Path) -> None:
    bearing, rotor = tmp_path / "bearing.toml", tmp_path / "rotor.toml"
    assert verb("calibrate", files["baseline"], *OPTIONS, "--out", bearing)[0] == 0
    probes = ("--probes", "x,y", "--speed-rpm", SPEED_RPM)
    known = ("--natural-frequency-hz", 60, "--damping-ratio", 0.1)
    orbit = Orbit().save(tmp_path / "orbit.npz")
    assert verb("calibrate", orbit, *probes, *known, "--out", rotor)[0] == 0
    for options, said in (
        ((*probes, "--calibration", bearing), "bearing.toml: was written of bearings, for pipeline.bearing"),
        ((*OPTIONS, "--calibration", rotor), "rotor.toml: was written of a rotor, for pipeline.rotor_syn"),
        (
            (*OPTIONS, "--baseline", bearing),
            "takes a recording; a file that daqsvc calibrate wrote of bearings",
        ),
        (
            (*OPTIONS[:6], "--baseline", bearing),
            "is for --calibration, with --bearing or --orders or a machine",
        ),
        ((*OPTIONS, "--baseline", files["baseline"], "--calibration", bearing), "leave out one of them"),
    ):
        code, found, err = verb("analyze", files["healthy"], *options)
        assert (code, found) == (2, [])
        assert said in err


def test_calibrate_says_of_times_that_go_back_as_analyze_does(
    files: dict[str, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    x = Housing(seed=1).samples
    t = np.arange(len(x)) / RATE_HZ
    t[600:610] = t[600:610][::-1].copy()
    np.savez(tmp_path / "back.npz", t=t, de=x)
    recording, options = str(tmp_path / "back.npz"), ("--channels", "de", *OPTIONS[4:])
    assert main(["analyze", recording, *options, "--json"]) == 0
    (note,) = json.loads(capsys.readouterr().out)["data_quality"]["problems"]
    assert "goes back in 9 steps" in note
    assert main(["calibrate", recording, *options, "--json"]) == 0
    assert capsys.readouterr().err == f"daqsvc calibrate: warning: {recording}: {note}\n"


def test_calibrate_by_options_refuses_a_damaged_bearing(
    verb: Run, files: dict[str, Path], tmp_path: Path
) -> None:
    out = tmp_path / "motor.toml"
    code, (made,), _ = verb("calibrate", files["baseline"], *OPTIONS, "--out", out)
    assert (code, made["refused"]) == (0, None)
    assert out.read_text().startswith("# A machine in good order")
    code, (made,), _ = verb("calibrate", files["outer"], *OPTIONS, "--out", tmp_path / "no.toml")
    assert code == 3
    assert "shows outer race damage" in made["refused"]
    assert not (tmp_path / "no.toml").exists()
    for options, said in (
        (("--channels", "de"), "--speed-rpm, --bearing or --orders must be given too"),
        ((*OPTIONS, "--probes", "x,y"), "--probes: not with --channels"),
        ((*OPTIONS, "--live"), "--live is for rotors"),
    ):
        code, _, err = verb("calibrate", files["baseline"], *options)
        assert code == 2
        assert said in err
