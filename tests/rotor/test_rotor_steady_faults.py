"""Which faults explain a steady change of a machine whose run-up made the bank, by the signatures."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from support.two_mode_rotors import UNIT_HZ, Machine, fitted, rubbing, run_up, vector_of

from daqsvc.rotor.adaptation import SteadyFit, SteadyMotion
from daqsvc.rotor.misfit import Misfit, SteadyChange, steady_baseline, steady_change
from daqsvc.rotor.model import RotorParameters
from daqsvc.rotor.steady_faults import Explanation, SteadyFaults, narrowed
from daqsvc.rotor.synchronous.vectors import WITH_THRICE

MACHINE = Machine()
SPEED_HZ = 28.0
CLEARANCE_UM = 130.0
VARIANCE = np.full(7, (0.002 * abs(MACHINE.orbit(SPEED_HZ)[0]) / CLEARANCE_UM) ** 2)
MODES = ("normal", "unbalance", "damping_loss", "static_load", "stiffness_loss", "rub")
NO_MOTIONS = np.zeros((len(MODES), 7), dtype=np.complex128)
DOWN = NO_MOTIONS.copy()
DOWN[3, 2] = -0.1j
"""Motions of modes of which the load is expected from above."""


@cache
def rotor(*, clockwise: bool = False) -> RotorParameters:
    fit = fitted(*run_up(MACHINE, 8.0, 50.0, 25.0))[1]
    stated = RotorParameters(
        natural_frequency_hz=UNIT_HZ,
        damping_ratio=0.1,
        eccentricity_um=10.0,
        clearance_um=CLEARANCE_UM,
        static_sag_um=-MACHINE.rest.imag,
    )
    return fit.rotor(stated, clockwise=clockwise)


def motion(vector):
    """A synchronous vector in the order of a steady motion, in clearances."""
    rest, forward, backward, *harmonics = vector
    return np.array([forward, backward, rest, *harmonics]) / CLEARANCE_UM


def judge(baseline, *, modes=MODES, motions=DOWN, parameters=None, speed_hz=SPEED_HZ):
    return SteadyFaults(
        parameters or rotor(),
        modes,
        motions,
        baseline=motion(baseline),
        variance=VARIANCE,
        speed_rad_s=math.tau * speed_hz,
    )


def likely(after, **known):
    before = vector_of(MACHINE, SPEED_HZ)
    return names(judge(before, **known).likely(SteadyChange(motion(after - before), 6400, VARIANCE)))


def names(found):
    """All that explains a change, of the bank or not."""
    return None if found is None else {*found.faults, *found.others}


def rub_vector(machine):
    z, theta = rubbing(machine, SPEED_HZ, CLEARANCE_UM, 2.0, 0.1, 10)
    return np.array([np.mean(z * np.exp(-1j * k * theta)) for k in WITH_THRICE])


GROWN = replace(MACHINE, eccentricity_um=1.6 * MACHINE.eccentricity_um)
LOADED = replace(MACHINE, load=1.4 * MACHINE.load)
LINEAR = [
    (GROWN, {"unbalance"}),
    (MACHINE.damped(0.5), {"damping_loss"}),
    (LOADED, {"static_load"}),
    (MACHINE.softened(0.7), {"stiffness_loss"}),
]


@pytest.mark.parametrize(("machine", "expected"), LINEAR)
def test_each_fault_explains_its_own_change(machine, expected):
    assert likely(vector_of(machine, SPEED_HZ)) == expected


@pytest.mark.parametrize(("machine", "expected"), LINEAR)
def test_a_shaft_that_turns_clockwise_is_judged_as_its_mirror(machine, expected):
    # The mirror image, x to -x, of all: forward stays forward.
    def mirrored(vector):
        return -np.conj(vector)

    before, after = (mirrored(vector_of(one, SPEED_HZ)) for one in (MACHINE, machine))
    found = judge(before, parameters=rotor(clockwise=True), speed_hz=-SPEED_HZ)
    assert names(found.likely(SteadyChange(motion(after - before), 6400, VARIANCE))) == expected


def test_a_rub_is_an_orbit_at_the_wall_with_harmonics():
    rub = rub_vector(replace(MACHINE, eccentricity_um=3.5 * MACHINE.eccentricity_um))
    assert likely(rub) == {"rub"}
    # The same harmonics of an orbit that is far from the wall are no rub's.
    far = vector_of(GROWN, SPEED_HZ)
    far[3:] = rub[3:]
    assert "rub" not in (likely(far) or ())


def test_a_shaft_that_rests_beside_the_wall_leaves_no_harmonics_and_does_not_rub():
    beside = vector_of(replace(MACHINE, load=2.7 * MACHINE.load), SPEED_HZ)
    assert abs(beside[0]) + abs(beside[1]) > 0.9 * CLEARANCE_UM
    assert likely(beside) == {"static_load"}


def test_where_noise_hides_harmonics_an_orbit_at_the_wall_may_rub():
    before = vector_of(MACHINE, SPEED_HZ)
    rub = rub_vector(replace(MACHINE, eccentricity_um=3.5 * MACHINE.eccentricity_um))
    rub[3:] = 0.0
    change = motion(rub - before)
    loud = judge(before).likely(SteadyChange(change, 640, np.full(7, 0.01**2)))
    quiet = judge(before).likely(SteadyChange(change, 640, VARIANCE))
    assert loud is not None
    assert "rub" in loud.faults
    assert "rub" not in (names(quiet) or ())


def test_a_fault_that_the_bank_has_no_mode_of_has_its_own_name():
    before, softer, loaded = (vector_of(one, SPEED_HZ) for one in (MACHINE, MACHINE.softened(0.7), LOADED))
    without = ("normal", "unbalance", "damping_loss", "static_load", "damping_loss", "rub")
    found = judge(before, modes=without).likely(SteadyChange(motion(softer - before), 6400, VARIANCE))
    assert found is not None
    assert (found.faults, found.others) == (frozenset(), ("stiffness_loss",))
    assert found.probabilities["stiffness_loss"] > 0.9
    assert found.evidence["stiffness_loss"] > 20.0
    assert likely(loaded, modes=without) == {"static_load"}


def test_of_unbalance_and_damping_that_with_a_mode_stays_beside_the_other():
    before, damped = (vector_of(one, SPEED_HZ) for one in (MACHINE, MACHINE.damped(0.5)))
    without = ("normal", "unbalance", "unbalance", "static_load", "stiffness_loss", "rub")
    found = judge(before, modes=without).likely(SteadyChange(motion(damped - before), 6400, VARIANCE))
    assert found is not None
    assert (found.faults, found.others) == (frozenset({"unbalance"}), ("damping_loss",))


def test_a_load_from_where_it_is_expected_is_told_from_a_softer_support_in_more_noise():
    before, after = (vector_of(one, SPEED_HZ) for one in (MACHINE, LOADED))
    loud = SteadyChange(motion(after - before), 640, np.full(7, 0.04**2))
    assert names(judge(before, motions=NO_MOTIONS).likely(loud)) == {"static_load", "stiffness_loss"}
    assert names(judge(before, motions=DOWN).likely(loud)) == {"static_load"}
    # From aside it is a load still.
    assert likely(vector_of(replace(MACHINE, load=MACHINE.load + 16), SPEED_HZ)) == {"static_load"}


def test_a_mode_that_has_no_steady_motion_tells_no_direction_of_a_load():
    both = np.vstack((DOWN, np.full((1, 7), np.nan)))
    loaded = vector_of(LOADED, SPEED_HZ)
    assert likely(loaded, modes=(*MODES, "static_load"), motions=both) == {"static_load"}


def test_what_no_fault_explains_is_unmodelled():
    strange = vector_of(MACHINE, SPEED_HZ)
    strange[2] += 12.0
    strange[3:5] += (6.0, -4.0j)
    assert likely(strange) == {"unmodelled"}


def test_before_there_is_a_change_nothing_is_excluded_by_it():
    before = vector_of(MACHINE, SPEED_HZ)
    assert likely(before) is None
    assert likely(before + 0.001 * np.abs(before[1])) is None


@pytest.mark.parametrize(("part", "expected"), [(1.03, None), (1.1, {"unbalance"})])
def test_a_small_change_gets_no_name_however_clear_it_is(part, expected):
    grown = replace(MACHINE, eccentricity_um=part * MACHINE.eccentricity_um)
    before, after = (vector_of(one, SPEED_HZ) for one in (MACHINE, grown))
    clear = SteadyChange(motion(after - before), 10**6, 1e-4 * VARIANCE)
    assert names(judge(before).likely(clear)) == expected


def test_without_harmonics_nothing_is_judged():
    before = vector_of(MACHINE, SPEED_HZ)
    moved = motion(vector_of(GROWN, SPEED_HZ) - before)
    blind = moved.copy()
    blind[3:] = np.nan
    for unknown in (moved[:3], blind):
        assert judge(before).likely(SteadyChange(unknown, 6400, None)) is None


def flags(*names):
    return np.array([mode in names for mode in MODES])


def off(*excluded):
    return Misfit(np.zeros(len(MODES)), flags(*excluded), np.zeros((len(MODES),) * 2, dtype=bool))


def test_what_is_not_likely_is_excluded_and_what_is_stays_together():
    found = narrowed(off("normal", "static_load"), np.array(MODES), {"static_load", "stiffness_loss"})
    assert (found.excluded == ~flags("static_load", "stiffness_loss")).all()
    assert found.pairs[3, 4]
    assert found.pairs.sum() == 2
    # What the signatures have judged is a change, however near the healthy machine is to what the modes do.
    alone = narrowed(off(), np.array(MODES), {"static_load"})
    assert alone.excluded[0]
    assert not alone.pairs.any()


def test_where_no_mode_explains_the_change_the_faults_stay_together_and_healthy_is_excluded():
    found = narrowed(off("static_load"), np.array(MODES), set())
    assert (found.excluded == flags("normal")).all()
    assert found.pairs[1:, 1:].sum() == 5 * 4
    assert not found.pairs[0].any()


def test_unbalance_and_damping_are_told_apart_where_the_modes_agree():
    faults, others = np.array(MODES), ("normal", "static_load", "stiffness_loss", "rub")
    agreed = narrowed(off(*others, "damping_loss"), faults, {"unbalance"})
    assert (~agreed.excluded == flags("unbalance")).all()
    for excluded in (others, (*others, "unbalance")):
        doubted = narrowed(off(*excluded), faults, {"unbalance"})
        assert (~doubted.excluded == flags("unbalance", "damping_loss")).all()
        assert doubted.pairs[1, 2]


def test_a_change_that_goes_on_is_judged_each_time_it_has_doubled(monkeypatch):
    before = vector_of(MACHINE, SPEED_HZ)
    found, judged, explained = judge(before), [], Explanation(frozenset({"unbalance"}), ("unmodelled",))
    monkeypatch.setattr(
        SteadyFaults, "likely", lambda self, change: judged.append(change.samples) or explained
    )
    found.forget()
    for revolutions in range(8, 300):
        found.look(SteadyChange(np.zeros(7), 64 * min(revolutions, 128)))
    assert judged == [64 * n for n in (8, 16, 32, 64, 128, 128)]
    # Another change: shorter by now.
    for revolutions in range(8, 17):
        found.look(SteadyChange(np.zeros(7), 64 * revolutions))
    assert judged[6:] == [64 * 8, 64 * 16]
    assert not narrowed(off(), np.array(MODES), {"unbalance"}).excluded[1]
    assert found.narrowed(off()).excluded[3]
    # An evaluation that shows nothing, as on the way back, excludes no mode and removes no name.
    monkeypatch.setattr(SteadyFaults, "likely", lambda *_: None)
    for revolutions in range(8, 17):
        found.look(SteadyChange(np.zeros(7), 64 * revolutions))
    assert not found.narrowed(off()).excluded.any()
    assert found.found is explained
    found.forget()
    assert found.found is None
    assert not found.narrowed(off()).excluded.any()


def orbit_of(motion_, count, per_rev=64):
    angle = math.tau * np.arange(count) / per_rev
    parts = [motion_.forward, motion_.backward, *(motion_.harmonics or ())]
    z = motion_.rest + sum(
        part * np.exp(1j * k * angle) for part, k in zip(parts, (1, -1, 2, -2, 3, -3), strict=False)
    )
    return np.column_stack((z.real, z.imag)), np.cos(angle), np.sin(angle)


def solved(xy, cos, sin):
    fit = SteadyFit()
    fit.add(xy, cos, sin)
    return fit.solve().with_harmonics(xy, cos, sin)


def test_harmonics_are_those_of_the_orbit_and_of_nothing_that_1x_leaves():
    truth = SteadyMotion(1.0 + 0.5j, 0.3j, -2.0, 64, (0.1, 0.05j, -0.02, 0.01 + 0.01j))
    np.testing.assert_allclose(solved(*orbit_of(truth, 64)).harmonics, truth.harmonics, atol=1e-12)
    plain = replace(truth, harmonics=None)
    for count in (64, 70, 55):
        np.testing.assert_allclose(solved(*orbit_of(plain, count)).harmonics, np.zeros(4), atol=1e-9)
    xy, cos, sin = orbit_of(truth, 64)
    xy[10:12] = np.nan
    np.testing.assert_allclose(solved(xy, cos, sin).harmonics, truth.harmonics, atol=0.03)


def test_few_samples_in_a_revolution_show_no_harmonics():
    truth = SteadyMotion(1.0, 0.0, 0.0, 12)
    found = solved(*orbit_of(truth, 12, per_rev=12))
    assert found.harmonics is None
    assert steady_baseline([found] * 20, 0.01) is None


def test_a_baseline_and_a_change_know_their_scatter():
    rng = np.random.default_rng(3)
    parts = 1.0 + 0.02 * (rng.standard_normal((40, 7)) + 1j * rng.standard_normal((40, 7)))
    motions = [SteadyMotion(*part[:3], 64, tuple(part[3:])) for part in parts]
    baseline = steady_baseline(motions, 1e-3)
    assert baseline is not None
    mean, variance = baseline
    np.testing.assert_allclose(mean, parts.mean(axis=0))
    np.testing.assert_allclose(variance, np.var(parts, axis=0) / 39)
    change = steady_change(motions, np.zeros(7), 1e-3)
    assert change is not None
    np.testing.assert_allclose(change.moved, mean)
    np.testing.assert_allclose(change.variance, variance)
    # Where the motions hardly scatter, it is what the noise makes.
    quiet = steady_baseline([motions[0]] * 40, 0.01)
    assert quiet is not None
    np.testing.assert_allclose(quiet[1], 2.0 * 0.01**2 / (40 * 64))


@pytest.mark.parametrize(("machine", "own"), LINEAR)
def test_what_is_predicted_is_what_an_exact_machine_would_be_called(machine, own):
    before = vector_of(MACHINE, SPEED_HZ)
    predicted = judge(before).predicted(
        SteadyChange(motion(vector_of(machine, SPEED_HZ) - before), 6400, VARIANCE)
    )
    assert predicted is not None
    assert predicted >= own
    assert judge(before).predicted(SteadyChange(np.zeros(7), 6400, VARIANCE)) is None


def test_what_is_predicted_allows_for_the_error_of_the_model():
    # A little more unbalance in noise is just told from weaker dampers, and not if the model is a little off.
    before = vector_of(MACHINE, SPEED_HZ)
    grown = vector_of(replace(MACHINE, eccentricity_um=1.1 * MACHINE.eccentricity_um), SPEED_HZ)
    change = SteadyChange(motion(grown - before), 6400, 12.0 * VARIANCE)
    assert names(judge(before).likely(change)) == {"unbalance"}
    assert judge(before).predicted(change) == {"unbalance", "damping_loss"}
