"""Orders without a keyphasor, and what two recordings say about a change of 1X."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

import numpy as np
import pytest
from support.formats import fits

from daqsvc.cli import main
from daqsvc.dsp.orders import order_vectors
from daqsvc.rotor.orders import OrderRules, compare_orders

if TYPE_CHECKING:
    from pathlib import Path

    from daqsvc.dsp.orders import OrderVectors
    from daqsvc.rotor.orders import OrderChange

RATE_HZ = 2000.0
RPM = 1500.0
AXES = np.array([1.0, 0.7j, 0.2])
HARMONICS = (1.0, 0.4, 0.2)


def record(
    seed: int,
    scale: tuple[float, ...] = (1.0, 1.0, 1.0),
    *,
    rpm: float = RPM,
    noise: float = 0.3,
    n: int = 4000,
) -> np.ndarray:
    """Orders 1 to 3 of three axes from an arbitrary shaft angle, and noise."""
    rng = np.random.default_rng(seed)
    angle = rng.uniform(0.0, 2.0 * np.pi) + 2.0 * np.pi * rpm / 60.0 / RATE_HZ * np.arange(n)
    samples = 0.9 + noise * rng.standard_normal((n, 3))
    for order, (amplitude, factor) in enumerate(zip(HARMONICS, scale, strict=True), 1):
        samples += amplitude * factor * np.real(np.outer(np.exp(1j * order * angle), AXES))
    return samples


def orders(seed: int, scale: tuple[float, ...] = (1.0, 1.0, 1.0), **more: float) -> OrderVectors:
    return order_vectors(record(seed, scale, **more), RATE_HZ, RPM)


def compared(scale: tuple[float, ...], seed: int = 10, **more: float) -> OrderChange:
    return compare_orders(orders(seed, **more), orders(seed + 1, scale, **more))


def test_measures_amplitudes_and_phases_between_channels() -> None:
    vectors = orders(1, noise=0.0)
    mean = vectors.amplitudes.mean(axis=0)
    np.testing.assert_allclose(np.abs(mean), np.outer(HARMONICS, np.abs(AXES)), rtol=2e-3)
    np.testing.assert_allclose(mean[:, 1] / mean[:, 0], 0.7j, rtol=2e-3)
    assert vectors.revolutions == 48
    assert vectors.residual_rms.max() < 1e-2


@pytest.mark.parametrize("rpm", [1460.0, 1499.3, 1500.0, 1531.7])
def test_finds_the_speed_with_an_honest_uncertainty(rpm: float) -> None:
    errors = []
    for seed in range(12):
        vectors = orders(seed, rpm=rpm)
        assert vectors.speed_seen
        errors.append((vectors.speed_rpm - rpm) / vectors.speed_uncertainty_rpm)
        assert vectors.speed_uncertainty_rpm < 0.5
    assert 0.2 < np.sqrt(np.mean(np.square(errors))) < 2.0


def test_says_when_no_order_stands_out() -> None:
    rng = np.random.default_rng(5)
    vectors = order_vectors(rng.standard_normal((4000, 2)), RATE_HZ, RPM)
    assert not vectors.speed_seen
    assert vectors.speed_uncertainty_rpm > 10.0


def test_takes_no_line_between_the_harmonics_for_the_shaft() -> None:
    samples = record(3)
    belt = 3.0 * np.cos(2.0 * np.pi * 1.013 * 2.0 * RPM / 60.0 / RATE_HZ * np.arange(len(samples)))
    vectors = order_vectors(samples + belt[:, np.newaxis], RATE_HZ, RPM)
    assert vectors.speed_rpm == pytest.approx(RPM, abs=1.5)


def test_missing_samples_cost_little() -> None:
    samples = record(4, noise=0.05)
    holes = samples.copy()
    holes[np.random.default_rng(0).random(len(holes)) < 0.1] = np.nan
    holes[100] = np.inf
    whole = order_vectors(samples, RATE_HZ, RPM)
    part = order_vectors(holes, RATE_HZ, RPM)
    assert compare_orders(whole, part).verdict == "normal"
    np.testing.assert_allclose(
        np.abs(part.amplitudes.mean(axis=0)), np.abs(whole.amplitudes.mean(axis=0)), atol=0.02
    )


@pytest.mark.parametrize("noise", [0.02, 0.3, 1.0])
def test_an_unchanged_machine_is_normal_whatever_its_phase(noise: float) -> None:
    for seed in range(20):
        change = compared((1.0, 1.0, 1.0), 100 + 2 * seed, noise=noise)
        assert (change.verdict, change.group) == ("normal", ("normal",))
        assert change.probabilities["normal"] > 0.5


@pytest.mark.parametrize("growth", [1.6, 2.0, 5.0])
def test_a_grown_1x_is_unbalance_or_less_damping(growth: float) -> None:
    change = compared((growth, 1.0, 1.0))
    assert change.verdict == "unbalance"
    assert change.group == ("unbalance", "damping_loss")
    assert change.growth == pytest.approx(growth, rel=0.1)
    assert change.growth_significant
    np.testing.assert_allclose(change.ratio[0, :2], growth, rtol=0.15)
    assert change.probabilities["unbalance"] == change.probabilities["damping_loss"] > 0.45


def test_harmonics_that_come_with_unbalance_do_not_hide_it() -> None:
    assert compared((6.0, 5.0, 6.0)).verdict == "unbalance"


def test_harmonics_that_grow_without_1x_are_no_unbalance() -> None:
    for scale in ((1.0, 6.0, 1.0), (1.0, 1.0, 15.0), (1.0, 6.0, 12.0)):
        assert compared(scale).group == ("unmodelled",), scale


def test_2x_that_grows_far_more_than_1x_is_no_sure_unbalance() -> None:
    assert "unmodelled" in compared((1.6, 12.0, 1.0)).group


def test_1x_that_falls_is_a_change_but_no_unbalance() -> None:
    change = compared((0.4, 1.0, 1.0), noise=0.05)
    assert change.group == ("unmodelled",)
    assert not change.growth_significant


def test_a_change_too_small_for_a_name() -> None:
    assert compared((1.15, 1.0, 1.0), noise=0.01).group == ("small_change",)
    assert compared((1.02, 1.0, 1.0), noise=0.001).group == ("normal",)


def test_vibration_beside_the_orders_is_a_change_of_unknown_cause() -> None:
    healthy = record(8)
    rough = record(9)
    rough += np.random.default_rng(1).standard_normal(rough.shape)
    change = compare_orders(order_vectors(healthy, RATE_HZ, RPM), order_vectors(rough, RATE_HZ, RPM))
    assert change.group == ("unmodelled",)
    assert change.residual_changed
    assert change.residual_ratio.min() > 2.0


def test_1x_that_wanders_by_itself_is_no_change() -> None:
    # A line 0.2 Hz beside 1X: halves of one recording differ by half of 1X and more.
    samples = record(2, n=8000, noise=0.02)
    beat = 0.5 * np.cos(2.0 * np.pi * (RPM / 60.0 + 0.12) / RATE_HZ * np.arange(8000))
    samples += beat[:, np.newaxis]
    first, second = (order_vectors(part, RATE_HZ, RPM) for part in (samples[:4000], samples[4000:]))
    change = compare_orders(first, second)
    assert change.growth > 1.15 or change.growth < 0.87
    assert change.verdict == "normal"


def driven(seed: int, motor: float) -> np.ndarray:
    """A motor of two poles at 2979 rpm: the line at twice the mains is 0.7 Hz beside 2X."""
    samples = record(seed, rpm=2979.0, n=20_000)
    t = np.arange(len(samples)) / RATE_HZ
    return samples + motor * np.outer(np.cos(2.0 * np.pi * 100.0 * t + seed), [1.0, 0.8, 0.3])


def test_a_motors_line_beside_2x_is_no_fault_of_the_rotor() -> None:
    before, after = (
        order_vectors(driven(seed, motor), RATE_HZ, 2979.0) for seed, motor in ((1, 0.2), (2, 2.0))
    )
    assert before.motor_hz == pytest.approx(100.0, abs=0.05)
    assert after.motor_hz == pytest.approx(100.0, abs=0.05)
    change = compare_orders(before, after, OrderRules())
    assert change.verdict == "normal"
    np.testing.assert_allclose(
        np.abs(after.amplitudes.mean(axis=0))[1], 0.4 * np.abs(AXES), rtol=0.1, atol=0.02
    )
    # A shaft's 2X that grows is still one.
    grown = order_vectors(
        driven(3, 0.2) + 0.5 * (record(4, rpm=2979.0, n=20_000, noise=0.0) - 0.9), RATE_HZ, 2979.0
    )
    assert compare_orders(before, grown, OrderRules()).verdict != "normal"
    assert orders(1).motor_hz is None


OF_A_MOTOR = (
    "a line of an induction motor stands out at 100.00 Hz, twice the mains: it counts as vibration beside "
    "the orders, and is no fault of the rotor"
)
OF_CABLES = (
    "a line stands out at 50.00 Hz, the mains, as cables pick them up: it counts as vibration beside the "
    "orders, and is no fault of the rotor"
)
OF_A_GEAR = (
    "a gear of 23 teeth on this shaft meshes at 568.1 Hz with a mate of 60 teeth: its lines count as "
    "vibration beside the orders"
)


@pytest.mark.parametrize(
    ("lines", "note"),
    [
        ({100.0: 0.4}, OF_A_MOTOR),
        ({50.0: 0.4}, OF_CABLES),
        (
            {23 * 24.7: 0.6, 46 * 24.7: 0.3}
            | {k * 23 * 24.7 + side * 24.7 * 23 / 60: 0.1 for k in (1, 2) for side in (-2, -1, 1, 2)},
            OF_A_GEAR,
        ),
    ],
)
def test_lines_of_a_drive_beside_the_orders_are_stated(
    lines: dict[float, float], note: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rate_hz = 4000.0
    t = np.arange(60_000) / rate_hz
    for name, size in (("healthy", 0.0), ("today", 1.0)):
        rng = np.random.default_rng(int(size))
        samples = 0.3 * rng.standard_normal((len(t), 1))
        samples[:, 0] += sum(a * np.cos(2 * np.pi * k * 24.7 * t) for k, a in enumerate(HARMONICS, 1))
        samples[:, 0] += size * sum(um * np.cos(2 * np.pi * hz * t + hz) for hz, um in lines.items())
        np.savez(tmp_path / f"{name}.npz", x=samples[:, 0], fs=rate_hz)
    options = ["--channels", "x", "--speed-rpm", "1482", "--json"]
    files = [str(tmp_path / "today.npz"), "--baseline", str(tmp_path / "healthy.npz")]
    assert main(["analyze", *files, *options]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["data_quality"]["problems"] == [note]
    assert document["verdict"] in {"normal", "unmodelled"}


def test_a_half_order_is_not_taken_for_the_mains() -> None:
    rate_hz = 4000.0
    t = np.arange(40_000) / rate_hz
    samples = 0.3 * np.random.default_rng(3).standard_normal(len(t))
    samples += sum(a * np.cos(2 * np.pi * k * 100.0 * t) for k, a in enumerate(HARMONICS, 1))
    assert order_vectors(samples + np.cos(2 * np.pi * 50.0 * t), rate_hz, 6000.0).mains_hz is None
    beside = order_vectors(samples + np.cos(2 * np.pi * 60.0 * t), rate_hz, 6000.0)
    assert beside.mains_hz == pytest.approx(60.0, abs=0.02)


def test_probabilities_sum_to_one() -> None:
    for scale in ((1.0, 1.0, 1.0), (1.3, 1.0, 1.0), (3.0, 2.0, 1.0), (1.0, 5.0, 1.0)):
        change = compared(scale)
        assert sum(change.probabilities.values()) == pytest.approx(1.0)
        assert change.verdict in change.group


def test_refuses_another_speed() -> None:
    with pytest.raises(ValueError, match=r"turns at 1620 rpm, \+8\.0% from the healthy run's 1500 rpm"):
        compare_orders(orders(1), order_vectors(record(2, rpm=1620.0), RATE_HZ, 1620.0))
    with pytest.raises(ValueError, match=r"turns at about (249|250)\d rpm by its harmonics, not at 1500 rpm"):
        order_vectors(record(2, rpm=2500.0), RATE_HZ, RPM)
    with pytest.raises(ValueError, match=r"turns at about 157\d rpm by its harmonics, not at 1500 rpm"):
        order_vectors(record(2, rpm=1575.0), RATE_HZ, RPM)


def test_refuses_other_channels() -> None:
    with pytest.raises(ValueError, match="3 channels and this one 1"):
        compare_orders(orders(1), order_vectors(record(2)[:, 0], RATE_HZ, RPM))


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda s: s[:300], r"has 3\.8 revolutions at 1500 rpm; at least 8"),
        (lambda s: np.where(np.arange(3) == 1, 0.9, s), r"channel 'Y' is dead: every sample is 0\.9"),
        (lambda s: np.minimum(s, 1.9), r"channel 'X' is clipped: .* of its samples are 1\.9"),
        (lambda s: np.full_like(s, np.nan), r"channel 'X': 4000 of 4000 samples are missing"),
    ],
)
def test_refuses_bad_samples(damage: object, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        order_vectors(damage(record(1)), RATE_HZ, RPM, ("X", "Y", "Z"))  # type: ignore[operator]


def test_refuses_a_rate_too_low() -> None:
    with pytest.raises(ValueError, match=r"200 Hz are 8\.0 samples per revolution"):
        order_vectors(record(1), 200.0, RPM)


def test_refuses_rules_that_cannot_be() -> None:
    with pytest.raises(ValueError, match="false-alarm probability of 0 "):
        OrderRules(false_alarm_probability=0.0)
    with pytest.raises(ValueError, match=r"least change of 0\.01"):
        OrderRules(least_change=0.01)


@pytest.fixture
def files(tmp_path: Path) -> Path:
    for name, samples in (
        ("healthy", record(20)),
        ("again", record(21)),
        ("heavy", record(22, (3.0, 1.0, 1.0))),
        ("short", record(23)[:200]),
    ):
        np.savetxt(tmp_path / f"{name}.csv", samples, delimiter=",", header="X,Y,Z", comments="")
    return tmp_path


def command(files: Path, *recordings: str) -> list[str]:
    paths = [str(files / f"{name}.csv") for name in recordings]
    return ["analyze", *paths, "--channels", "X,Y,Z", "--fs", "2000", "--speed-rpm", "1500"]


def test_the_command_judges_each_recording(files: Path, capsys: pytest.CaptureFixture[str]) -> None:
    baseline = ["--baseline", str(files / "healthy.csv"), "--json"]
    assert main([*command(files, "again", "heavy", "short"), *baseline]) == 3
    again, heavy, short = (
        fits("daqsvc analyze", json.loads(line)) for line in capsys.readouterr().out.splitlines()
    )
    assert (again["verdict"], again["group"]) == ("normal", ["normal"])
    assert (heavy["verdict"], heavy["group"]) == ("unbalance", ["unbalance", "damping_loss"])
    assert heavy["growth_1x"]["ratio"] == pytest.approx(3.0, rel=0.1)
    assert heavy["channels"]["X"]["orders"]["1X"]["ratio"] == pytest.approx(3.0, rel=0.1)
    # 3 g at 157 rad/s
    assert heavy["channels"]["X"]["velocity_1x_mm_s_rms"] == pytest.approx(132.0, rel=0.05)
    assert short["verdict"] is None
    assert "revolutions" in short["refused"]
    assert main([*command(files, "heavy"), *baseline[:2], "--unit", "V"]) == 0
    assert "unbalance or damping loss (cannot be told apart)" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ([], "--baseline must be given too"),
        (["--baseline", "nowhere.csv"], "healthy run nowhere.csv: "),
        (["--baseline", "{healthy}", "--unit", "um"], "--unit um: accelerometers measure in g, m/s2, mg, "),
        (["--baseline", "{healthy}", "--probes", "X,Y"], "--probes: not with --channels"),
        (["--baseline", "{short}"], "has 2.5 revolutions"),
        (["--baseline", "{healthy}", "--false-alarm-probability", "2"], "not a probability"),
    ],
)
def test_the_command_refuses_misuse(
    files: Path, capsys: pytest.CaptureFixture[str], options: list[str], message: str
) -> None:
    named = [o.format(healthy=files / "healthy.csv", short=files / "short.csv") for o in options]
    with pytest.raises(SystemExit) as stop:
        main([*command(files, "again"), *named])
    assert stop.value.code == 2
    assert message in capsys.readouterr().err


def test_probes_measure_no_acceleration(files: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["analyze", str(files / "again.csv"), "--probes", "X,Y", "--speed-rpm", "1500", "--unit", "g"])
    assert "proximity probes measure in m, mm, um, mil" in capsys.readouterr().err


def test_a_healthy_run_without_orders_is_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    noise = 0.3 * np.random.default_rng(5).standard_normal((4000, 3))
    for name, samples in (("quiet", noise), ("healthy", record(1)), ("today", record(2))):
        np.savez(tmp_path / f"{name}.npz", **dict(zip("xyz", samples.T, strict=True)), fs=RATE_HZ)
    problems = []
    for baseline in ("quiet", "healthy"):
        options = ["--channels", "x,y,z", "--speed-rpm", f"{RPM:g}", "--json"]
        files = [str(tmp_path / "today.npz"), "--baseline", str(tmp_path / f"{baseline}.npz")]
        assert main(["analyze", *files, *options]) == 0
        problems.append(json.loads(capsys.readouterr().out)["data_quality"]["problems"])
    assert len(problems[0]) == 1
    assert "no order of 1500 rpm stands out of the healthy run" in problems[0][0]
    assert problems[1] == []
