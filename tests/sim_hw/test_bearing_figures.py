"""What figures 8 to 10 of the paper rest on: the unit of the faulty race stays, the other one leaves."""

from __future__ import annotations

import pytest

from sim_hw.reproduce.bearing.experiment import RACES, BearingExperiment, run


@pytest.fixture(scope="module")
def experiment() -> BearingExperiment:
    return run(seed=1, snr_db=20.0)


@pytest.mark.parametrize("fault", RACES)
def test_the_other_unit_is_a_hundred_times_as_far_off(experiment, fault) -> None:
    other = RACES[1 - RACES.index(fault)]
    stays, leaves = experiment.leaving(fault, fault), experiment.leaving(fault, other)
    assert leaves / stays >= 100.0
    assert leaves > 0.1


@pytest.mark.parametrize("race", RACES)
def test_the_implicit_unit_of_the_faulty_race_does_not_leave_at_all(experiment, race) -> None:
    assert experiment.still[race, race] < 1e-12
