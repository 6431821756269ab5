"""The modes of a rotor bank in the machine file: every fault with its levels, and what is wrong with them."""

from __future__ import annotations

import pytest
from support.machine_files import LAVAL, MACHINES, changed, only_problem, parsed, problems_of

from daqsvc.detectors.make import detectors
from daqsvc.settings import describe, load_machine_file, parse_machine_file

TWELVE = MACHINES / "laval-rig-twelve-modes.toml"
MODES = "pipeline.rotor_bank.modes"


def bank_of(machine):
    return next(d for d in detectors(machine) if d.name == "rotor-bank")


def test_twelve_modes_become_the_models_they_describe():
    bank = bank_of(load_machine_file(TWELVE))
    rotors = {mode.name: mode.rotor for mode in bank.bank_modes}
    assert len(rotors) == 12
    healthy = rotors["N"]
    assert (healthy.e, healthy.zeta, healthy.k) == pytest.approx((0.1, 0.18, 1.0))
    assert healthy.rest == pytest.approx(-0.1j)
    assert rotors["U2"].e == pytest.approx(0.18)
    assert rotors["U2"].zeta == healthy.zeta
    assert rotors["L3"].rest == pytest.approx(-0.3j)
    assert rotors["L3"].orbit() == pytest.approx(healthy.orbit())
    assert rotors["K2"].k == pytest.approx(0.9)
    assert rotors["K2"].rest == pytest.approx(-0.1j / 0.9)
    assert rotors["D2"].zeta == pytest.approx(0.06)
    assert [mode.name for mode in bank.bank_modes if mode.rub] == ["R"]
    assert rotors["R"].contact_radius == pytest.approx(250.0)
    assert bank.faults == {
        "N": "normal",
        **dict.fromkeys(("U1", "U2", "U3"), "unbalance"),
        **dict.fromkeys(("L1", "L2", "L3"), "static_load"),
        **dict.fromkeys(("D1", "D2"), "damping_loss"),
        "R": "rub",
        **dict.fromkeys(("K1", "K2"), "stiffness_loss"),
    }


def test_static_load_has_two_directions():
    modes = {
        mode.name: mode.rotor
        for mode in bank_of(
            parsed(TWELVE, ("static_load_um = [0.0, -5.0]", "static_load_um = [7.0, 3.0]"))
        ).bank_modes
    }
    assert modes["L1"].rest == pytest.approx(0.07 - 0.07j)


@pytest.mark.parametrize(("load", "meant"), [("15.0", "-15.0"), ("-5", "-5.0"), ("0", "0.0")])
def test_static_load_as_one_number_is_refused_with_both_directions(load: str, meant: str) -> None:
    problem, _ = only_problem(TWELVE, ("static_load_um = [0.0, -5.0]", f"static_load_um = {load}"))
    assert problem.key == f"{MODES}[4].static_load_um"
    assert problem.message == "must be two numbers in brackets, x and y"
    assert problem.remedy.startswith(f"write e.g. static_load_um = [0.0, {meant}] (additional sag")


def test_faults_of_a_file_that_does_not_name_them():
    assert bank_of(load_machine_file(LAVAL)).faults == {
        "N": "normal",
        "F1": "damping_loss",
        "F1L2": "damping_loss",
        "F1L3": "rub",
    }


def test_rotor_may_have_a_side_load_and_a_contact_radius():
    text, _ = changed(
        LAVAL,
        ("static_sag_um = 10.0", "static_sag_um = 10.0\nstatic_load_x_um = 4.0\ncontact_radius_um = 5e3"),
    )
    healthy = bank_of(parse_machine_file(text, LAVAL)).bank_modes[0].rotor
    assert healthy.rest == pytest.approx(0.04 - 0.1j)
    assert healthy.contact_radius == pytest.approx(50.0)


def test_probes_in_other_units_reach_the_bank_in_micrometres():
    text, _ = changed(
        LAVAL,
        ('unit = "um"\nsensitivity_mv_per_unit = 7.87 ', 'unit = "mil"\nsensitivity_mv_per_unit = 200.0 '),
    )
    assert bank_of(parse_machine_file(text, LAVAL))._units == pytest.approx([25.4, 1.0, 1.0])


def test_thresholds_from_rates():
    rules = bank_of(load_machine_file(TWELVE)).rules
    # ln(1000 * 64 * 11 / 0.02) and ln(600 * 60 * 10,000 * 64 * 11)
    assert rules.threshold_nats == pytest.approx(17.38, abs=0.01)
    assert rules.back_threshold_nats == pytest.approx(26.26, abs=0.01)
    rules = bank_of(load_machine_file(LAVAL)).rules
    assert (rules.threshold_nats, rules.back_threshold_nats) == (16.0, 25.0)


@pytest.mark.parametrize(
    ("replacements", "key", "message", "remedy"),
    [
        (
            [('unbalance_ratio = 1.3, severity = "alert"', 'severity = "alert"')],
            f"{MODES}[1].fault",
            "no figure of this mode",
            "unbalance_ratio = 1.8",
        ),
        (
            [("damping_ratio = 0.10", "damping_ratio = 0.20")],
            f"{MODES}[7].fault",
            "no figure of this mode",
            "damping_ratio = 0.09, below",
        ),
        (
            [("stiffness_ratio = 0.95", "stiffness_ratio = 1.05")],
            f"{MODES}[10].fault",
            "no figure of this mode",
            "stiffness_ratio = 0.9",
        ),
        ([("rub = true, ", "")], f"{MODES}[9].fault", "no figure of this mode", "rub = true"),
        (
            [("[0.0, -5.0]", "[0.0, 0.0]")],
            f"{MODES}[4].fault",
            "no figure of this mode",
            "static_load_um = [0.0, -10.0]",
        ),
        (
            [('fault = "unbalance", unbalance_ratio = 1.3, ', "")],
            f"{MODES}[1]",
            '"U1" is not worse',
            "damping_ratio, static_load_um, stiffness_ratio, rub, or remove",
        ),
        (
            [('name = "N", ', 'name = "N", unbalance_ratio = 1.1, ')],
            f"{MODES}[0].unbalance_ratio",
            "healthy one",
            "[machine.rotor]",
        ),
        (
            [('name = "N", ', 'name = "N", damping_ratio = 0.17, ')],
            f"{MODES}[0].damping_ratio",
            "0.18 of [machine.rotor]",
            "correct one",
        ),
        (
            [('name = "N", ', 'name = "N", fault = "rub", rub = true, ')],
            f"{MODES}[0].fault",
            "healthy one",
            "remove",
        ),
        (
            [("mtbf_hours", "back_threshold_nats = 20.0\nmtbf_hours")],
            "pipeline.rotor_bank.back_threshold_nats",
            "by mtbf_hours already",
            "remove one",
        ),
        (
            [("rev = 0.02", "rev = 5e3 ")],
            "pipeline.rotor_bank.false_alarms_per_1000_rev",
            "at every revolution",
            "0.02",
        ),
    ],
)
def test_modes_that_cannot_be_meant(replacements, key, message, remedy):
    text, _ = changed(TWELVE, *replacements)
    problems = {problem.key: problem for problem in problems_of(text, TWELVE)}
    assert message in problems[key].message
    assert remedy in problems[key].remedy


def test_unknown_fault_is_told_the_ones_there_are():
    problem, line = only_problem(TWELVE, ('fault = "rub"', 'fault = "wear"'))
    assert (problem.key, problem.line) == (f"{MODES}[9].fault", line)
    assert "stiffness_loss" in str(problem)


@pytest.mark.parametrize("value", ["-0.1", "inf", '"1.8"'])
def test_impossible_level(value):
    problem, _ = only_problem(TWELVE, ("unbalance_ratio = 1.8", f"unbalance_ratio = {value}"))
    assert problem.key == f"{MODES}[2].unbalance_ratio"


def test_static_load_is_not_looked_for_with_ac_coupled_probes():
    text, _ = changed(TWELVE, ("angle_deg = 90.0", "angle_deg = 90.0\nac_coupled = true"))
    problems = problems_of(text, TWELVE)
    assert [problem.key for problem in problems] == [f"{MODES}[{i}].static_load_um" for i in (4, 5, 6)]
    assert {problem.remedy for problem in problems} == {
        "use DC-coupled probes (ac_coupled = false), or remove the mode"
    }


def test_ac_coupled_probes_are_described_and_their_models_have_no_static_position():
    machine = parsed(LAVAL, ("angle_deg = 90.0", "angle_deg = 90.0\nac_coupled = true"))
    assert "AC-coupled" in describe(machine)
    assert {mode.rotor.rest for mode in bank_of(machine).bank_modes} == {0.0}


def test_modes_and_rates_are_described():
    text = " ".join(describe(load_machine_file(TWELVE)).split())
    for words in (
        "U3 (unbalance x 2.5: danger)",
        "L2 (static load 0, -10 um: alert)",
        "D2 (zeta 0.06: alert)",
        "R (zeta 0.02, rub: danger)",
        "K1 (stiffness x 0.95: alert)",
        "at most 0.02 false alarms in 1000 revolutions",
        "MTBF 10000 h",
        "from the first 20 revolutions",
    ):
        assert words in text


ONLY_MODELLED = [
    ("eccentricity_um = 10.0", "eccentricity_um"),
    ("contact_stiffness = 30.0", "contact_stiffness"),
]


@pytest.mark.parametrize(("line", "key"), ONLY_MODELLED)
def test_the_bank_needs_what_it_models(line, key):
    text, _ = changed(LAVAL, (line, "#"))
    (problem,) = problems_of(text)
    assert problem.key == f"machine.rotor.{key}"
    assert text.split("\n")[problem.line - 1].startswith("[machine.rotor]")
    assert "the model bank needs it" in problem.message
    assert f"add e.g. {line}" in problem.remedy


def test_a_rotor_without_a_bank_need_not_be_modelled():
    text = (MACHINES / "rotor-synchronous.toml").read_text(encoding="utf-8")
    assert not any(f"{key} =" in text for _, key in ONLY_MODELLED)
    described = describe(parse_machine_file(text, MACHINES / "rotor-synchronous.toml"))
    assert "damping ratio 0.1, clearance 100 um, sag 10 um\n" in described
