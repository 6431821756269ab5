"""Each fault leaves its own mark on the synchronous vector, and what none of them leaves gets no name."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from support.rotor_orbits import HEALTHY, ROTOR, SPEED_RAD_S

from daqsvc.rotor.laval import compliance, unbalance_response
from daqsvc.rotor.synchronous.baseline import Calibration
from daqsvc.rotor.synchronous.signatures import (
    NAMED_BY_RUN_UP,
    TEMPERATURE,
    NamingRules,
    _group,
    damping_misfit,
    identify,
    likelihoods,
)
from daqsvc.rotor.synchronous.vectors import HARMONICS, WITH_THRICE, Healthy

ORDER = np.array(HARMONICS)
VARIANCE = np.full(5, (0.004 * abs(HEALTHY[1])) ** 2)


def healthy(speed=1.0, *, laval=True, ellipticity=0.0, rotor=ROTOR):
    baseline = HEALTHY.copy()
    baseline[1] = 10.0 * complex(unbalance_response(speed, 0.18))
    baseline[2] = ellipticity * abs(baseline[1]) * np.exp(0.4j)
    return Healthy(baseline, speed * SPEED_RAD_S, rotor, laval)


def judged(change, machine, variance=VARIANCE):
    scores = likelihoods(np.asarray(change, dtype=complex), variance, machine, machine.baseline + change)
    best = max(scores, key=scores.get)
    return best, scores


def only(k, value):
    change = np.zeros(5, dtype=complex)
    change[HARMONICS.index(k)] = value
    return change


def pulse(angle_rad, force_um, speed=1.0, width=0.6):
    """Response to a push in the direction of ``force_um`` at one angle of the shaft."""
    passed = compliance(ORDER * speed, 0.18)
    return force_um * passed * np.exp(-((ORDER * width) ** 2) / 2.0 - 1j * ORDER * angle_rad)


def wall_at(angle_rad, machine, depth_um):
    """A rub where the whirl reaches furthest in its direction at this shaft angle."""
    outwards = machine.baseline[1] * np.exp(1j * angle_rad)
    return -depth_um * outwards / abs(outwards)


def test_no_change_is_normal():
    best, scores = judged(0.002 * abs(HEALTHY[1]) * np.exp(1j * np.arange(5)), healthy())
    assert best == "normal"
    assert scores["normal"] == 0.0


@pytest.mark.parametrize("speed", [0.6, 1.0, 1.3])
def test_1x_that_shrinks_is_unbalance(speed):
    machine = healthy(speed)
    change = only(1, -0.6 * machine.baseline[1])
    best, scores = judged(change, machine)
    assert best == "unbalance"
    others = [name for name in scores if name != "unbalance"]
    assert all(scores["unbalance"] - scores[name] > 5.0 for name in others)


def test_at_the_critical_speed_growth_in_phase_is_unbalance_or_damping_and_nothing_else():
    machine = healthy(1.0)
    _, scores = judged(only(1, 0.8 * machine.baseline[1]), machine)
    assert scores["unbalance"] == scores["damping_loss"]
    others = [name for name in scores if name not in {"unbalance", "damping_loss"}]
    assert all(scores["unbalance"] - scores[name] > 5.0 for name in others)


def test_below_the_critical_speed_no_loss_of_damping_doubles_1x():
    machine = healthy(0.6)
    _, scores = judged(only(1, machine.baseline[1]), machine)
    assert scores["unbalance"] - scores["damping_loss"] > 5.0


@pytest.mark.parametrize("left", [0.3, 0.6, 0.8])
@pytest.mark.parametrize("speed", [0.8, 1.0, 1.1])
def test_a_loss_of_damping_is_never_taken_out_of_the_group(left, speed):
    machine = healthy(speed)
    ratio = complex(unbalance_response(speed, 0.18 * left) / unbalance_response(speed, 0.18))
    change = only(1, machine.baseline[1] * (ratio - 1.0))
    assert damping_misfit(change, VARIANCE, machine) < 5.0


@pytest.mark.parametrize("direction_deg", [-90.0, 30.0, 180.0])
def test_a_moved_mean_position_is_a_static_load(direction_deg):
    best, scores = judged(only(0, 8.0 * np.exp(1j * math.radians(direction_deg))), healthy())
    assert best == "static_load"
    assert scores["static_load"] - scores["unmodelled"] > 5.0


@pytest.mark.parametrize("stiffness", [0.9, 0.75, 0.6])
@pytest.mark.parametrize("speed", [0.7, 1.0])
def test_a_softer_shaft_moves_position_and_1x_together(stiffness, speed):
    machine = healthy(speed)
    damped = 2j * 0.18 * speed
    ratio = (1.0 - speed**2 + damped) / (stiffness - speed**2 + damped)
    change = only(1, machine.baseline[1] * (ratio - 1.0)) + only(0, -10.0j * (1.0 / stiffness - 1.0))
    best, scores = judged(change, machine)
    assert best == "stiffness_loss"
    assert scores["stiffness_loss"] - max(s for n, s in scores.items() if n != best) > 5.0


@pytest.mark.parametrize("angle_deg", [20.0, 140.0, 300.0])
@pytest.mark.parametrize("speed", [0.5, 1.0])
def test_a_push_inwards_once_a_revolution_is_a_rub(angle_deg, speed):
    machine = healthy(speed)
    # The wall stands where the whirl leads to and the disc already lies, off the centre.
    machine.baseline[0] = 0.3 * machine.baseline[1] * np.exp(1j * math.radians(angle_deg))
    change = pulse(math.radians(angle_deg), wall_at(math.radians(angle_deg), machine, 3.0), speed)
    best, scores = judged(change, machine)
    assert best == "rub"
    assert scores["rub"] - scores["unmodelled"] > 5.0


def test_a_push_along_the_sag_is_not_called_a_rub():
    """A crack at half the critical speed has the harmonics of a rub, but pulls the other way."""
    machine = healthy(0.5)
    change = pulse(math.radians(180.0), -1.0j, speed=0.5)
    best, scores = judged(change, machine)
    assert best == "unmodelled"
    assert scores["unmodelled"] - scores["rub"] > 5.0


@pytest.mark.parametrize("speed", [0.5, 0.7, 1.3])
def test_a_crack_that_opens_once_a_revolution_is_no_rub(speed):
    """It pulls along itself and turns with the shaft (Mayes and Davies 1984): backward 3X is hardly there."""
    machine = healthy(speed)
    theta = 2.0 * math.pi * np.arange(256) / 256.0
    along = np.exp(1j * (theta + 0.7))
    bent = machine.baseline[1] * np.exp(1j * theta) - 1j * machine.rotor.sag_um
    force = 0.3 * (1.0 - along.imag) / 2.0 * (bent * along.conj()).real * along
    order = np.array(WITH_THRICE)
    change = compliance(order * speed, 0.18) * (force @ np.exp(-1j * np.outer(theta, order))) / len(theta)
    variance = np.full(7, VARIANCE[0])
    scores = likelihoods(change, variance, machine, machine.baseline + change[:5])
    assert scores["unmodelled"] - scores["rub"] > 5.0


def test_2x_alone_is_unmodelled():
    best, scores = judged(only(-2, 4.0), healthy())
    assert best == "unmodelled"
    assert all(scores["unmodelled"] - s > 5.0 for n, s in scores.items() if n != best)


def test_an_orbit_that_fills_the_clearance_touches_whatever_its_shape():
    machine = healthy()
    change = only(1, -72.0j) + only(-1, 3.0) + only(2, 2.5j)
    best, _ = judged(change, machine)
    assert best == "rub"
    wide = healthy(rotor=replace(ROTOR, clearance_um=1000.0))
    assert judged(change, wide)[0] == "unmodelled"


def test_a_shaft_that_a_load_bends_to_the_wall_does_not_rub():
    # Sag and whirl take 88 of 105 um; the load a part of the rest, or nearly all of it.
    machine = healthy(rotor=replace(ROTOR, clearance_um=105.0))
    machine = replace(machine, baseline=machine.baseline + only(0, -50.0j))
    for load, variance in ((-10.0j, VARIANCE), (-14.0j, 0.01 * VARIANCE)):
        assert abs(machine.baseline[0] + load) + abs(machine.baseline[1]) > 0.9 * 105.0
        best, scores = judged(only(0, load), machine, variance)
        assert best == "static_load"
        assert scores["static_load"] - scores["rub"] > 5.0
    # The same with harmonics.
    touched = only(0, -14.0j) + only(2, 1.5) + only(-2, 1.0j)
    assert judged(touched, machine, 0.01 * VARIANCE)[0] == "rub"


def test_a_whirl_around_the_clearance_rubs_without_harmonics():
    machine = healthy()
    clearance_um = machine.rotor.clearance_um
    around = only(1, clearance_um - machine.baseline[1]) + only(0, 0.02 * clearance_um)
    assert judged(around, machine)[0] == "rub"


def test_an_elliptic_orbit_grows_in_both_senses_with_the_unbalance():
    machine = healthy(laval=False, ellipticity=0.3)
    factor = 0.7 * np.exp(0.5j)
    change = only(1, factor * machine.baseline[1]) + only(-1, np.conj(factor) * machine.baseline[2])
    best, scores = judged(change, machine)
    assert best == "unbalance"
    assert scores["unbalance"] - scores["unmodelled"] > 5.0


def test_a_change_without_harmonics_is_never_a_rub_first():
    """Mean position and both senses of 1X fit the pulse of a rub within its tolerance: no contact."""
    machine = healthy(laval=False, ellipticity=0.4)
    angle = math.radians(140.0)
    machine.baseline[0] = 0.3 * machine.baseline[1] * np.exp(1j * angle)
    pushed = pulse(angle, wall_at(angle, machine, 6.0))
    assert judged(pushed, machine)[0] == "rub"
    linear = pushed.copy()
    linear[3:] = 0.0
    assert judged(linear, machine)[0] != "rub"
    seen = np.full(5, (0.0005 * abs(pushed[1])) ** 2)
    _, scores = judged(linear, machine, seen)
    assert max(scores.values()) - scores["rub"] > 10.0
    # Where noise may hide the harmonics the rub stays in the group.
    hidden = np.full(5, (0.1 * abs(pushed[1])) ** 2)
    best, scores = judged(linear, machine, hidden)
    assert best != "rub"
    assert max(scores.values()) - scores["rub"] < 5.0


@pytest.mark.parametrize("share", [0.0001, 0.004, 0.03])
@pytest.mark.parametrize("laval", [True, False])
def test_a_shift_with_forward_1x_and_nothing_else_is_never_a_rub_first(share: float, *, laval: bool):
    """Of the pulse's many shapes there is always one that moves these two as they moved."""
    machine = healthy(1.3, laval=laval, ellipticity=0.0 if laval else 0.2)
    variance = np.full(5, (share * machine.amplitude_um) ** 2 + machine.floor_um2)
    for shift in np.exp(1j * np.radians(np.arange(0.0, 360.0, 30.0))):
        for turned in (0.3, -0.2j, -0.4 + 0.3j):
            change = only(0, 4.0 * shift) + only(1, turned * machine.baseline[1])
            best, scores = judged(change, machine, variance)
            assert best != "rub"
            if share < 0.001:  # its harmonics would be seen
                assert max(scores.values()) - scores["rub"] > 10.0


def test_what_a_machine_wanders_by_does_not_hide_that_nothing_touches():
    machine = healthy(1.3, rotor=replace(ROTOR, clearance_um=60.0))
    machine = replace(machine, baseline=machine.baseline + only(0, -20.0j))
    room = 60.0 - 20.0 - abs(machine.baseline[1])
    variance = np.full(5, (1e-4 * machine.amplitude_um) ** 2 + machine.floor_um2)
    linear = only(0, -0.6j * room) + only(1, 0.3 * room * machine.baseline[1] / abs(machine.baseline[1]))
    best, scores = judged(linear, machine, variance)
    assert best != "rub"
    assert max(scores.values()) - scores["rub"] > 10.0
    touched = linear + only(2, 0.03 * room)
    assert judged(touched, machine, variance)[0] == "rub"


def test_motion_that_does_not_repeat_is_a_mark_of_contact():
    machine = healthy(0.6, laval=False)
    angle = math.radians(140.0)
    machine.baseline[0] = 0.3 * machine.baseline[1] * np.exp(1j * angle)
    linear = pulse(angle, wall_at(angle, machine, 2.0), 0.6, width=1.0)
    linear[3:] = 0.0
    hidden = np.full(5, (0.1 * np.abs(linear).max()) ** 2)
    quiet, loud = (
        likelihoods(linear, hidden, machine, machine.baseline + linear, shaken=shaken) for shaken in (0, 1)
    )
    assert max(quiet, key=quiet.get) != "rub"
    assert max(loud, key=loud.get) == "rub"
    # The model of a Laval rotor tells by itself how a pulse moves it, where noise hides the harmonics.
    known = healthy(0.6)
    known.baseline[0] = machine.baseline[0]
    quiet = likelihoods(linear, hidden, known, known.baseline + linear)
    assert max(quiet, key=quiet.get) == "rub"


@pytest.mark.parametrize("down_deg", [-40.0, 0.0, 40.0])
def test_without_a_laval_rotor_a_shaft_that_sinks_may_be_softer_or_loaded(down_deg):
    machine = healthy(laval=False, ellipticity=0.2)
    sinks = only(0, -5.0j * np.exp(1j * math.radians(down_deg)))
    _, scores = judged(sinks, machine)
    assert abs(scores["static_load"] - scores["stiffness_loss"]) < 5.0
    rises, _ = judged(-sinks, machine)
    assert rises == "static_load"
    # A softer support lets 1X go; a load takes it along by a part of the way only.
    best, scores = judged(sinks + only(1, 9.0j), machine)
    assert best == "stiffness_loss"
    assert scores["stiffness_loss"] - scores["static_load"] > 5.0


def test_without_a_laval_rotor_1x_that_turns_as_the_sink_tells_is_a_softer_support():
    machine = healthy(0.7, laval=False, ellipticity=0.2)
    depth = 0.2
    softer = unbalance_response(0.7 * math.sqrt(1.0 + depth), 0.18) / unbalance_response(0.7, 0.18)
    sinks = only(0, -1j * depth * ROTOR.sag_um)
    turned = machine.baseline[1] * (softer - 1.0)

    def lead(turn):
        _, scores = judged(sinks + only(1, turn), machine)
        return scores["stiffness_loss"] - scores["static_load"]

    assert lead(turned) > 5.0
    # As large a change the other way is none that a softer support makes.
    assert lead(turned) > lead(-turned) + 2.0


def healthy_run(machine: Healthy) -> Calibration:
    return Calibration(
        rotor=ROTOR,
        speed_rpm=SPEED_RAD_S * 30.0 / math.pi,
        revolutions=100,
        baseline=machine.baseline,
        variance=VARIANCE,
        noise=1e-3,
        noise_variance=0.01,
        samples_per_rev=64.0,
    )


def test_probabilities_are_of_tempered_evidence():
    machine = healthy(laval=False, ellipticity=0.2)
    change = only(0, -5.0j)
    found = identify(change, VARIANCE, healthy_run(machine), previous=None, rules=NamingRules())
    first, second = sorted(found.evidence, key=found.evidence.get, reverse=True)[:2]
    odds = found.probabilities[first] / found.probabilities[second]
    assert odds == pytest.approx(math.exp((found.evidence[first] - found.evidence[second]) / TEMPERATURE))
    assert sum(found.probabilities.values()) == pytest.approx(1.0)


def test_a_name_that_is_kept_keeps_its_probabilities():
    machine, rules = healthy(), NamingRules()
    calibration, load = healthy_run(machine), only(0, 3.0j)
    first = identify(load, VARIANCE, calibration, previous=None, rules=rules)
    named = identify(load, VARIANCE, calibration, previous=first, rules=rules)
    assert named.named
    other = identify(only(-2, 4.0), VARIANCE, calibration, previous=named, rules=rules)
    assert other.candidates == ("unmodelled",)
    assert (other.verdict, other.group) == (named.verdict, named.group)
    assert max(other.probabilities, key=lambda name: other.probabilities[name]) == other.verdict


def test_without_a_laval_rotor_a_load_may_stiffen_the_oil_film():
    machine = healthy(laval=False, ellipticity=0.5)
    change = only(0, 8.0 + 7.0j) + only(1, 1.6) + only(-1, 1.0j)
    best, scores = judged(change, machine)
    assert best == "static_load"
    assert scores["static_load"] - scores["stiffness_loss"] > 5.0
    on_springs = replace(machine, rotor=replace(machine.rotor, plain_bearings=False))
    assert judged(change, on_springs)[1]["static_load"] < scores["static_load"] - 50.0


@pytest.mark.parametrize(
    ("best", "behind", "marked", "together"),
    [
        ("unbalance", 1.0, False, True),
        ("unbalance", 3.0, False, False),
        ("unbalance", 3.0, True, True),
        ("damping_loss", 3.0, False, False),
        ("stiffness_loss", 3.0, False, True),
        ("rub", -3.0, False, True),
    ],
)
@pytest.mark.parametrize("modelled", [True, False])
def test_a_rub_without_a_mark_is_left_out_sooner_where_1x_alone_explains_it(
    best: str, behind: float, *, marked: bool, together: bool, modelled: bool
):
    """And never the other way round: a rub that leads leaves unbalance in the group.

    Nor where no model tells what the pulse of a rub would do.
    """
    other = "unbalance" if best == "rub" else best
    scores = {"normal": 0.0, "unbalance": 50.0, other: 100.0, "rub": 100.0 - behind}
    before = healthy_run(healthy())
    assert before.healthy.modelled
    if not modelled:
        before = replace(before, fit_error=1.0)
    group = _group(scores, best, before, NamingRules(), marked=marked)
    assert ({other, "rub"} == set(group)) == (together or not modelled)


@pytest.mark.parametrize("other", ["stiffness_loss", "unmodelled"])
@pytest.mark.parametrize(
    ("behind", "rules", "together"),
    [(4.9, NamingRules(), True), (3.6, NAMED_BY_RUN_UP, False), (3.4, NAMED_BY_RUN_UP, True)],
)
def test_a_run_up_parts_what_is_less_far_apart(
    other: str, behind: float, rules: NamingRules, *, together: bool
):
    scores = {"normal": 0.0, "rub": 100.0, other: 100.0 - behind}
    group = _group(scores, "rub", healthy_run(healthy()), rules, marked=True)
    assert group == (("rub", other) if together else ("rub",))


def test_1x_that_moves_alone_is_no_stiffness_loss_where_the_mean_position_is_known():
    machine = healthy(0.7, laval=False, ellipticity=0.2)
    still = VARIANCE.copy()
    still[0] = (0.002 * machine.rotor.sag_um) ** 2
    _, scores = judged(only(1, 0.6j * machine.baseline[1]), machine, still)
    assert scores["unbalance"] - scores["stiffness_loss"] > 5.0


def test_without_a_laval_rotor_position_and_1x_together_are_still_stiffness():
    machine = healthy(laval=False, ellipticity=0.2)
    change = only(0, 6.0 - 3.0j) + only(1, 9.0j) + only(-1, 3.0)
    best, scores = judged(change, machine)
    assert best == "stiffness_loss"
    assert scores["stiffness_loss"] - scores["unmodelled"] > 5.0


def test_a_mean_position_that_nobody_knows_says_nothing():
    blind = VARIANCE.copy()
    blind[0] = 1e8
    machine = healthy(0.7)
    _, scores = judged(only(0, 30.0), machine, blind)
    assert scores["static_load"] < 1.0
    best, _ = judged(only(0, 30.0) + only(1, 10.0j), machine, blind)
    assert best == "unbalance"
