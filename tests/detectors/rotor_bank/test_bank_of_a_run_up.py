"""A bank whose observers come from a run-up: from the recording to a name, and what is refused."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest
from support.given_codes import had
from support.machine_files import MACHINES, changed, only_problem
from support.two_mode_rotors import RATE_HZ, Machine, rubbing, run_up

from daqsvc.alarms.rules import decision_evidence
from daqsvc.cli import main
from daqsvc.detectors.rotor_bank.build import bank_detector, healthy_rotor
from daqsvc.detectors.rotor_bank.plugin import RotorBankPlugin
from daqsvc.detectors.rotor_bank.settings import RotorBank
from daqsvc.diagnosis.detector import Window
from daqsvc.rotor.calibration.file import load_record, save_record
from daqsvc.rotor.model import Pedestal
from daqsvc.rotor.steady_faults import SteadyFaults
from daqsvc.settings import parse_machine_file
from daqsvc.settings.problems import AssemblyError

if TYPE_CHECKING:
    from pathlib import Path

pytestmark = pytest.mark.integration
TWELVE = MACHINES / "laval-rig-twelve-modes.toml"
MACHINE = Machine()
SPEED_HZ = 28.0
NOISE_UM = 2.0
ON_THIS_RIG = (
    ("speed_rpm = 600.0", f"speed_rpm = {60.0 * SPEED_HZ}"),
    ("natural_frequency_hz = 10.0 ", "natural_frequency_hz = 30.0 "),
    ("clearance_um = 100.0", "clearance_um = 250.0"),
    ("static_sag_um = 10.0", "static_sag_um = 38.0"),
    ("rate_hz = 640.0", f"rate_hz = {RATE_HZ}"),
    ("noise_um = 2.0", f'noise_um = {NOISE_UM}\ncalibration = "rotor.toml"'),
)


def keyphasor_volts(angle):
    return np.where(np.mod(angle, math.tau) < math.tau - 0.35, -2.0, -10.0)


def channels(position, angle, seed=0):
    rng = np.random.default_rng(seed)
    noise = NOISE_UM * rng.standard_normal((len(position), 2))
    return np.column_stack((position.real + noise[:, 0], position.imag + noise[:, 1], keyphasor_volts(angle)))


@pytest.fixture(scope="module")
def calibrated(tmp_path_factory) -> Path:
    """A folder with the calibration that ``daqsvc calibrate`` makes of a run-up, and the run-up."""
    return calibrated_in(tmp_path_factory.mktemp("rig"), MACHINE, clearance_um=250)


def calibrated_in(folder: Path, machine: Machine, clearance_um: int) -> Path:
    write(folder / "run-up.csv", *run_up(machine, 8.0, 50.0, 20.0))
    arguments = ["calibrate", str(folder / "run-up.csv"), "--probes", "x,y", "--keyphasor", "kph"]
    arguments += ["--fs", str(RATE_HZ), "--unit", "um"]
    arguments += ["--clearance-um", f"{clearance_um}"]
    assert main([*arguments, "--out", str(folder / "rotor.toml")]) == 0
    return folder


def write(file: Path, position, angle) -> None:
    table = channels(position, angle)
    np.savetxt(file, table, fmt="%.3f", delimiter=",", header="x,y,kph", comments="")


def machine_of(folder: Path, *more: tuple[str, str]):
    path = folder / "machine.toml"
    path.write_text(changed(TWELVE, *ON_THIS_RIG, *more)[0], encoding="utf-8")
    return parse_machine_file(path.read_text(encoding="utf-8"), path)


def settings_of(machine) -> RotorBank:
    table = machine.pipeline.table(RotorBank)
    assert table is not None
    return table


def said_of(machine, parts, seed=0):
    """What the bank says of steady stretches, 60 revolutions each; of a machine, or of its positions."""
    detector = bank_detector(machine, settings_of(machine))
    n = round(60.0 * RATE_HZ / SPEED_HZ)
    angle = 0.4 + math.tau * SPEED_HZ / RATE_HZ * np.arange(n * len(parts))
    position = np.concatenate(
        [of(angle[k * n : k * n + n]) for k, one in enumerate(parts) for of in (positions_of(one),)]
    )
    return detector, said_by(detector, channels(position, angle, seed).astype(np.float32))


def said_by(detector, samples):
    said = []
    for begin in range(0, len(samples), detector.block):
        part = samples[begin : begin + detector.block]
        last = begin + len(part) - 1
        said += detector.process(Window(begin, part, round(last * 1e9 / RATE_HZ), 1e9 / RATE_HZ))
    return said


def positions_of(part):
    """Position by shaft angle, of a machine without contact; or what does that already."""
    if not isinstance(part, Machine):
        return part
    forward, backward = part.orbit(SPEED_HZ)
    return lambda angle: forward * np.exp(1j * angle) + backward * np.exp(-1j * angle) + part.rest


def rub_of(machine, clearance_um, stiffness):
    """Positions of a machine that rubs once a revolution, by shaft angle."""
    z, theta = rubbing(machine, SPEED_HZ, clearance_um, stiffness, 0.1, 4)
    spectrum = [(k, np.mean(z * np.exp(-1j * k * theta))) for k in range(-12, 13)]
    return lambda angle: sum(part * np.exp(1j * k * angle) for k, part in spectrum)


@pytest.mark.long
def test_the_run_up_is_in_the_file(calibrated):
    record = load_record(calibrated / "rotor.toml")
    assert record.two_modes is not None
    assert record.two_modes.explains
    assert record.two_modes.modes.support_share == pytest.approx(1.0 / 3.0, abs=0.06)
    text = (calibrated / "rotor.toml").read_text(encoding="utf-8")
    assert "two modes explain 1X from" in text
    assert "[two_modes]" in text


@pytest.mark.long
def test_a_steady_recording_is_stated_to_have_the_two_modes_of_the_run_up(calibrated, tmp_path, capsys):
    angle = 0.4 + math.tau * SPEED_HZ / RATE_HZ * np.arange(round(120.0 * RATE_HZ / SPEED_HZ))
    write(tmp_path / "steady.csv", positions_of(MACHINE)(angle), angle)
    recordings = [str(calibrated / "run-up.csv"), str(tmp_path / "steady.csv")]
    options = ["--probes", "x,y", "--keyphasor", "kph", "--fs", str(RATE_HZ), "--unit", "um"]
    options += ["--clearance-um", "250"]
    assert main(["calibrate", *recordings, *options, "--out", str(tmp_path / "rotor.toml")]) == 0
    for told in (capsys.readouterr().out, (tmp_path / "rotor.toml").read_text(encoding="utf-8")):
        assert "the two modes of its run-up show how faults move it" in told
        assert "generic mode" not in told
    assert main(["calibrate", *recordings, *options, "--json"]) == 0
    (steady,) = json.loads(capsys.readouterr().out)["steady"]
    assert "the two modes of its run-up show how faults move it" in steady["verdict"]


@pytest.mark.parametrize(
    ("fault", "part"), [("damping_loss", MACHINE.damped(0.4)), ("stiffness_loss", MACHINE.softened(0.7))]
)
def test_faults_of_a_machine_that_is_no_laval_rotor_are_named(calibrated, fault, part):
    detector, said = said_of(machine_of(calibrated), [MACHINE, part])
    healthy = [one for one in said if one.end_index < 60.0 * RATE_HZ / SPEED_HZ and one.quality == "good"]
    assert {one.decision for one in healthy} <= {"undetermined", "N"}
    assert healthy[-1].decision == "N"
    assert detector.faults[said[-1].decision] == fault


BACKWARD = Machine(supports=(1.7, 3.8), dampers=(0.5, 0.5))
"""Between its two critical speeds the orbit turns backwards: 49 um against 36 um forward."""
WIDE = ("clearance_um = 250.0", "clearance_um = 400.0")


def test_a_healthy_orbit_that_turns_backwards_is_watched_by_a_bank_of_its_run_up(tmp_path):
    calibrated_in(tmp_path, BACKWARD, clearance_um=400)
    detector, said = said_of(machine_of(tmp_path, WIDE), [BACKWARD, BACKWARD.softened(0.7)])
    healthy = [one for one in said if one.end_index < 60.0 * RATE_HZ / SPEED_HZ]
    assert {one.quality for one in healthy[8:]} == {"good"}
    assert healthy[-1].decision == "N"
    assert said[-1].decision != "N"
    assert "stiffness_loss" in {detector.faults[name] for name in (said[-1].decision, *said[-1].group)}


def test_an_orbit_of_no_clear_direction_is_said_where_nothing_tells_that_it_may_be(tmp_path):
    without = [(old, new.partition("\ncalibration")[0]) for old, new in (*ON_THIS_RIG, WIDE)]
    path = tmp_path / "machine.toml"
    path.write_text(changed(TWELVE, *without)[0], encoding="utf-8")
    _, said = said_of(parse_machine_file(path.read_text(encoding="utf-8"), path), [BACKWARD])
    assert {one.decision for one in said} == {"undetermined"}
    assert said[-1].quality == "not_ok"
    assert "the orbit does not turn clearly with the shaft (1X radius 0.0" in said[-1].reason
    assert "calibrate the rotor by a run-up" in said[-1].reason


RUB_ROOM_UM = 130.0
GROWN = 3.5
RUBS = (
    ("clearance_um = 250.0", f"clearance_um = {RUB_ROOM_UM}"),
    ("contact_stiffness = 30.0", "contact_stiffness = 2.0"),
    ("unbalance_ratio = 2.5", f"unbalance_ratio = {GROWN}"),
    (
        '{ name = "R", fault = "rub", damping_ratio = 0.02, rub = true',
        f'{{ name = "R", fault = "rub", unbalance_ratio = {GROWN}, rub = true',
    ),
)


def test_a_rub_is_not_called_by_the_unbalance_that_it_comes_from(calibrated):
    # By its innovations, unbalance is the likelier: the observer of a rub is noisy by design. But no
    # unbalance turns backward as this does, and none moves the mean position.
    more = replace(MACHINE, eccentricity_um=GROWN * MACHINE.eccentricity_um)
    machine = machine_of(calibrated, *RUBS)
    detector, said = said_of(machine, [MACHINE, rub_of(more, RUB_ROOM_UM, 2.0)])
    assert (said[-1].decision, said[-1].group) == ("R", ())
    assert detector.faults["R"] == "rub"
    assert said[-1].statistics["misfit"] < 0.05
    assert "misfit" not in said[0].statistics


def test_a_softer_shaft_is_a_loss_of_stiffness_though_no_mode_moves_so(calibrated):
    # The modes have softer supports only. But the shaft sinks, and 1X moves with it.
    softer = replace(MACHINE, shaft=0.8 * MACHINE.shaft)
    detector, said = said_of(machine_of(calibrated), [MACHINE, softer])
    assert {detector.faults[name] for name in (said[-1].decision, *said[-1].group)} == {"stiffness_loss"}
    assert said[-1].statistics["misfit"] > 0.3


def test_what_no_fault_explains_is_unmodelled_until_the_machine_is_healthy_again(calibrated):
    # Backward whirl without forward, a shift aside, and 2X far from the wall.
    move = positions_of(MACHINE)

    def strange(angle):
        return move(angle) + 12.0 * np.exp(-1j * angle) + 6.0 + 6.0 * np.exp(2j * angle)

    _, said = said_of(machine_of(calibrated), [move, strange, move])
    during = [one for one in said if 75 < one.revolutions < 118]
    assert {(one.decision, one.group, one.severity) for one in during} == {("unmodelled", (), "alert")}
    assert during[-1].statistics["misfit"] > 0.3
    assert during[-1].probabilities["unmodelled"] > 0.9
    assert sum(during[-1].probabilities.values()) == pytest.approx(1.0)
    assert decision_evidence(during[-1]) > 20.0
    first, *_, last = (one for one in said if one.changed and one.revolutions > 60)
    assert first.first_index == pytest.approx(60 * RATE_HZ / SPEED_HZ, abs=RATE_HZ / SPEED_HZ)
    assert (last.decision, last.severity) == ("N", "normal")
    # On the way back it is not called by the nearest mode.
    assert {one.decision for one in said if one.revolutions > 75} == {"unmodelled", "N"}


def test_what_a_bank_of_a_run_up_names_besides_its_modes_is_among_its_readings(calibrated):
    machine = machine_of(calibrated)
    detector, said = said_of(machine, [MACHINE])
    readings = RotorBankPlugin().readings(machine, settings_of(machine))
    listed = [one.key for one in readings if one.kind == "probabilities"]
    assert listed == [*detector.faults, "unmodelled"]
    assert list(said[-1].probabilities) == listed
    assert said[-1].probabilities["unmodelled"] == 0.0


def test_a_fault_without_a_mode_has_its_own_name(calibrated):
    few = tuple(
        (
            f'fault = "stiffness_loss", stiffness_ratio = {ratio}',
            f'fault = "unbalance", unbalance_ratio = {part}',
        )
        for ratio, part in (("0.95", 1.5), ("0.90", 1.6))
    )
    machine = machine_of(calibrated, *few)
    detector, said = said_of(machine, [MACHINE, MACHINE.softened(0.7)])
    assert "stiffness_loss" not in detector.faults.values()
    assert (said[-1].decision, said[-1].group) == ("stiffness_loss", ())
    assert said[-1].severity != "normal"
    (silent,) = detector.silent(2.0, said[-1].t_ns)
    assert (silent.decision, silent.severity) == (said[-1].decision, said[-1].severity)


LESS_DAMPED = (("0.10", "0.032"), ("0.06", "0.028"))


def test_a_healthy_machine_whose_speed_hunts_near_its_critical_speed_stays_healthy(tmp_path):
    # It is calibrated while the speed falls through a percent: what is measured is the motion at the mean of
    # it, and 1X follows late.
    critical = Machine(supports=(2.3, 2.4), dampers=(0.5, 0.5))
    calibrated_in(tmp_path, critical, clearance_um=900)
    wide = ("clearance_um = 250.0", "clearance_um = 900.0")
    milder = [
        (f"damping_ratio = {of}, severity", f"damping_ratio = {to}, severity") for of, to in LESS_DAMPED
    ]
    machine = machine_of(tmp_path, wide, *milder)
    turns = SPEED_HZ * np.arange(round(160.0 * RATE_HZ / SPEED_HZ)) / RATE_HZ
    angle = math.tau * turns + 0.8 * np.sin(math.tau * turns / 80.0)
    samples = channels(critical.move(angle), angle).astype(np.float32)
    said = said_by(bank_detector(machine, settings_of(machine)), samples)
    assert {one.decision for one in said if one.revolutions > 30} == {"N"}


def test_a_bank_whose_modes_are_several_faults_in_one_is_judged_by_its_modes(calibrated, monkeypatch):
    judged = []
    monkeypatch.setattr(SteadyFaults, "likely", lambda self, change: judged.append(change))
    both = ("unbalance_ratio = 2.5", "unbalance_ratio = 2.5, damping_ratio = 0.1")
    detector, said = said_of(machine_of(calibrated, both), [MACHINE, MACHINE.damped(0.4)])
    assert not judged
    assert detector.faults[said[-1].decision] == "damping_loss"
    said_of(machine_of(calibrated), [MACHINE, MACHINE.damped(0.4)])
    assert judged


@pytest.mark.parametrize("aside_um", [10.0, 20.0])
def test_a_load_from_the_side_is_one_load_and_no_coming_and_going(calibrated, aside_um):
    # No mode of the bank moves so. The observers of the healthy machine are the nearest, and it has changed.
    loaded = replace(MACHINE, load=MACHINE.load + aside_um)
    detector, said = said_of(machine_of(calibrated), [MACHINE, loaded, loaded])
    decisions = [one.decision for one in said if one.revolutions > 90]
    assert len(set(decisions)) == 1
    assert {detector.faults[name] for name in (said[-1].decision, *said[-1].group)} == {"static_load"}


def test_a_load_mode_that_may_touch_leaves_a_load_a_load(calibrated):
    load = 'fault = "static_load", static_load_um = [0.0, -20.0]'
    touching = f'{{ name = "RL", {load}, rub = true, severity = "alert" }}'
    detector, said = said_of(
        machine_of(calibrated, ('{ name = "K1"', f'{touching},\n  {{ name = "K1"')),
        [MACHINE, replace(MACHINE, load=1.5 * MACHINE.load)],
    )
    assert {detector.faults[name] for name in (said[-1].decision, *said[-1].group)} == {"static_load"}


def test_revolutions_of_a_bad_probe_are_no_steady_motion(calibrated):
    machine = machine_of(calibrated)
    detector = bank_detector(machine, settings_of(machine))
    revolution = RATE_HZ / SPEED_HZ
    angle = 0.4 + math.tau / revolution * np.arange(round(160 * revolution))
    samples = channels(positions_of(MACHINE)(angle), angle).astype(np.float32)
    bad = slice(round(80 * revolution), round(100 * revolution))
    samples[bad, 0] = 0.5 * np.random.default_rng(1).standard_normal(bad.stop - bad.start)
    said = said_by(detector, samples)
    assert {one.quality for one in said if 85 < one.revolutions < 95} == {"not_ok"}
    assert {one.decision for one in said if one.revolutions > 25} == {"N"}


def test_a_shaft_that_a_load_bends_to_the_wall_does_not_rub(calibrated):
    # 83 um below the centre with an orbit of 37 um, in a clearance of 130 um.
    loaded = replace(MACHINE, load=2.2 * MACHINE.load)
    detector, said = said_of(machine_of(calibrated, *RUBS), [MACHINE, loaded])
    assert {detector.faults[name] for name in (said[-1].decision, *said[-1].group)} == {"static_load"}


FOLLOWING = ("calibrate_revolutions = 20", "calibrate_revolutions = 20\nprocess_noise = 0.05")
"""Observers that are so unsure of their machine that they follow whatever it does."""


def grown(part):
    return replace(MACHINE, eccentricity_um=part * MACHINE.eccentricity_um)


def test_an_orbit_that_observers_follow_is_seen_by_its_steady_motion(calibrated):
    machine = machine_of(calibrated, FOLLOWING)
    detector, said = said_of(machine, [MACHINE, grown(1.5), MACHINE])
    begin, end = (k * 60.0 * RATE_HZ / SPEED_HZ for k in (1, 2))
    healthy_again = said[-1]
    during = [one for one in said if begin < one.end_index <= end]
    # By themselves they take it for the healthy machine, whatever it does.
    assert detector._bank.look_alike(0)[[mode.name for mode in detector.bank_modes].index("U1")]
    assert {one.decision for one in said if one.end_index <= begin and one.revolutions > 25} == {"N"}
    assert detector.faults[during[-1].decision] == "unbalance"
    assert "N" not in during[-1].group
    assert healthy_again.decision == "N"


def test_what_only_the_steady_motion_shows_is_predicted(calibrated, capsys):
    machine_of(calibrated, FOLLOWING)
    arguments = ["detectability", str(calibrated / "machine.toml")]
    assert main([*arguments, "--json"]) == 0
    predicted = json.loads(capsys.readouterr().out)
    seen = {tuple(one["modes"]): one["by_steady_1x"] for one in predicted["ambiguous"]}
    assert seen["N", "U1"]
    # Of two faults neither is the healthy machine, and a load moves no 1X.
    assert not any(shown for (first, _), shown in seen.items() if first != "N")
    assert main(arguments) == 0
    printed = capsys.readouterr().out
    assert "The observers take U1 for N at 1680 rpm, but it is seen in the steady 1X" in printed


def test_faults_that_are_stated_together_are_predicted(calibrated, monkeypatch):
    machine = machine_of(calibrated, (f"noise_um = {NOISE_UM}", "noise_um = 20.0"))
    monkeypatch.setitem(globals(), "NOISE_UM", 20.0)
    detector, said = said_of(machine, [MACHINE, grown(1.4)])
    stated = {detector.faults[name] for name in said[-1].group}
    assert said[-1].decision == "U1"
    assert stated == {"unbalance", "damping_loss"} == {*detector.predicted_groups()["U1"]}


def test_a_change_that_no_observer_sees_is_predicted_as_healthy(calibrated):
    # Only 1X, and where the shaft rests, show what observers follow; this damping moves 1X by 9 %.
    milder = ("damping_ratio = 0.10, severity", "damping_ratio = 0.155, severity")
    detector, said = said_of(machine_of(calibrated, FOLLOWING, milder), [MACHINE, MACHINE.damped(0.87)])
    assert said[-1].decision == "N"
    assert "normal" in detector.predicted_groups()["D1"]


def test_a_load_that_no_observer_sees_is_predicted_and_seen_by_where_the_shaft_rests(calibrated):
    move = positions_of(MACHINE)
    detector, said = said_of(machine_of(calibrated, FOLLOWING), [move, lambda angle: move(angle) - 10j])
    assert detector._bank.look_alike(0)[[mode.name for mode in detector.bank_modes].index("L2")]
    assert detector.faults[said[-1].decision] == "static_load"
    assert "normal" not in detector.predicted_groups()["L2"]


def test_a_load_on_oil_films_is_predicted_to_look_like_a_softer_support(calibrated, capsys):
    # Far below the critical speed both move the mean position, and 1X by less than noise hides.
    on_films = ("clearance_um = 250.0", "clearance_um = 250.0\nplain_bearings = true")
    machine_of(calibrated, on_films, (f"noise_um = {NOISE_UM}", "noise_um = 15.0"))
    arguments = ["detectability", str(calibrated / "machine.toml"), "--speed-rpm", "600"]
    assert main([*arguments, "--json"]) == 0
    groups = {one["mode"]: set(one["faults"]) for one in json.loads(capsys.readouterr().out)["groups"]}
    assert all(groups[mode] == {"static_load", "stiffness_loss"} for mode in ("L1", "L3", "K1", "K2"))
    assert "static_load" not in groups["U1"]
    assert main(arguments) == 0
    assert (
        "L1, L2, L3, K1, K2 would be called static_load or stiffness_loss at 600 rpm"
        in capsys.readouterr().out
    )


@pytest.mark.parametrize("part", [1.0, 1.05])
def test_a_machine_that_hunts_about_its_critical_speed_is_healthy(calibrated, part):
    machine = machine_of(calibrated, FOLLOWING)
    detector = bank_detector(machine, settings_of(machine))
    turns = np.arange(round(400.0 * RATE_HZ / SPEED_HZ)) * SPEED_HZ / RATE_HZ
    angle = math.tau * (turns + 0.01 * 50.0 / math.tau * np.sin(math.tau * turns / 50.0))
    position = MACHINE.move(angle)
    position[len(position) // 2 :] = grown(part).move(angle)[len(position) // 2 :]
    samples = channels(position, angle).astype(np.float32)
    said = said_by(detector, samples[round(30.0 * RATE_HZ / SPEED_HZ) :])
    assert {one.decision for one in said if one.revolutions > 25} == {"N"}


def test_a_run_up_needs_healthy_revolutions_beside_it(calibrated):
    problem, _ = only_problem(
        TWELVE, *ON_THIS_RIG, ("calibrate_revolutions = 20", "calibrate_revolutions = 0")
    )
    assert "calibrate_revolutions" in str(problem)
    assert str(problem).endswith("write e.g. calibrate_revolutions = 50 [D14]")
    had("D14", problem)


def test_the_eccentricity_need_not_be_stated(calibrated):
    machine = machine_of(calibrated, ("eccentricity_um = 10.0 ", "#"))
    assert bank_detector(machine, settings_of(machine)).bank_modes[0].rotor.e > 0.0


@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (lambda record: replace(record, two_modes=None), "holds no run-up"),
        (
            lambda record: replace(record, two_modes=replace(record.two_modes, fit_error=0.4)),
            r"two modes do not explain .*rotor_synchronous",
        ),
        (
            lambda record: replace(
                record,
                run_up=replace(record.run_up, speed_range_rpm=(2400.0, 3000.0)),
            ),
            "the run-up went from 2400 to 3000 rpm, and machine.speed_rpm is 1680",
        ),
    ],
)
def test_what_cannot_be_used_is_said(calibrated, tmp_path, spoil, said):
    machine = machine_of(tmp_path)
    save_record(spoil(load_record(calibrated / "rotor.toml")), tmp_path / "rotor.toml")
    with pytest.raises(AssemblyError, match=said) as caught:
        RotorBankPlugin().check_files(machine, settings_of(machine))
    assert "pipeline.rotor_bank.calibration" in str(caught.value)
    assert "rotor.toml" in str(caught.value)


def test_a_file_that_is_not_there_is_said(tmp_path):
    machine = machine_of(tmp_path)
    with pytest.raises(AssemblyError, match=r"rotor\.toml: No such file"):
        RotorBankPlugin().check_files(machine, settings_of(machine))


@pytest.mark.long
def test_what_can_be_told_apart_is_known_beforehand(calibrated, capsys):
    machine_of(calibrated)
    assert main(["detectability", str(calibrated / "machine.toml"), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    pairs = {(pair["truth"], pair["rival"]): pair for pair in told["pairs"]}
    assert pairs["D1", "N"]["nats_per_rev"] > 1.0
    assert pairs["U3", "N"]["delay_rev"] < pairs["U1", "N"]["delay_rev"]
    smallest = {change["fault"]: change for change in told["smallest_change"]}
    assert 1.0 < smallest["unbalance"]["by_bank"] < 1.3


def softest(machine):
    detector = bank_detector(machine, settings_of(machine))
    (mode,) = (mode for mode in detector.bank_modes if mode.name == "K2")
    return mode.rotor, healthy_rotor(machine, settings_of(machine))


def test_on_oil_films_a_softer_support_is_in_series_with_the_film(calibrated):
    known = "[machine.rotor]                  #"
    springs, rotor = softest(machine_of(calibrated))
    assert springs.k == rotor.faulty(60.0 * SPEED_HZ, stiffness_ratio=0.9).k
    films, rotor = softest(machine_of(calibrated, (known, known.replace("#", "\nplain_bearings = true\n#"))))
    assert films.k == rotor.faulty(60.0 * SPEED_HZ, pedestal=Pedestal(1.0 / 0.9 - 1.0)).k
    assert films.k != springs.k
    assert films.rest == pytest.approx(springs.rest, rel=1e-6)


def test_observers_of_a_small_orbit_in_its_clearance_are_less_noisy(calibrated):
    def of(clearance_um, *more):
        size = ("clearance_um = 250.0", f"clearance_um = {clearance_um}")
        machine = machine_of(calibrated, size, *more)
        modes = bank_detector(machine, settings_of(machine)).bank_modes
        return modes[0].rotor, modes[0].process_noise

    assert of(250.0)[1] == 1e-4
    rotor, noise = of(2500.0)
    assert abs(rotor.orbit()) < 0.02
    assert noise == pytest.approx(1e-4 * (abs(rotor.orbit()) / 0.1) ** 2)
    stated = ("calibrate_revolutions = 20", "calibrate_revolutions = 20\nprocess_noise = 3e-4")
    assert of(2500.0, stated)[1] == 3e-4


def test_a_load_from_the_side_that_observers_follow_is_seen_by_where_the_shaft_rests(calibrated):
    # 20 um is the largest load of the modes, which are all from above; 3 um may be drift of a probe.
    machine = machine_of(calibrated, FOLLOWING)
    parts = [
        MACHINE,
        replace(MACHINE, load=MACHINE.load + 3.0),
        replace(MACHINE, load=MACHINE.load + 20.0),
        MACHINE,
    ]
    detector, said = said_of(machine, parts)
    at = [one for one in said if one.quality == "good" and one.revolutions > 25]
    assert {one.decision for one in at if one.revolutions < 119} == {"N"}
    loaded = [one for one in at if 135 < one.revolutions < 179]
    assert {detector.faults[one.decision] for one in loaded} == {"static_load"}
    assert at[-1].decision == "N"
