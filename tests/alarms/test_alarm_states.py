"""The state table, against the diagram of ISA-18.2 written out by hand."""

from __future__ import annotations

import itertools

import pytest

from daqsvc.alarms.states import AlarmState, CommandNotAllowedError, Hold, Level, Stimulus, shown, transition

S = AlarmState
OWN = [
    S.NORMAL,
    S.ACTIVE_UNACKNOWLEDGED,
    S.ACTIVE_ACKNOWLEDGED,
    S.RETURNED_UNACKNOWLEDGED,
    S.LATCHED_UNACKNOWLEDGED,
    S.LATCHED_ACKNOWLEDGED,
]


def follow(*stimuli: str, latching: bool) -> AlarmState:
    state = S.NORMAL
    for stimulus in stimuli:
        state = transition(state, Stimulus(stimulus), latching=latching)
    return state


@pytest.mark.parametrize(
    ("stimuli", "latching", "state"),
    [
        (["raise"], False, S.ACTIVE_UNACKNOWLEDGED),
        (["raise", "acknowledge"], False, S.ACTIVE_ACKNOWLEDGED),
        (["raise", "acknowledge", "escalate"], False, S.ACTIVE_UNACKNOWLEDGED),
        (["raise", "acknowledge", "clear"], False, S.NORMAL),
        (["raise", "clear"], False, S.RETURNED_UNACKNOWLEDGED),
        (["raise", "clear", "raise"], False, S.ACTIVE_UNACKNOWLEDGED),
        (["raise", "clear", "acknowledge"], False, S.NORMAL),
        (["raise", "clear"], True, S.LATCHED_UNACKNOWLEDGED),
        (["raise", "acknowledge", "clear"], True, S.LATCHED_ACKNOWLEDGED),
        (["raise", "clear", "acknowledge"], True, S.LATCHED_ACKNOWLEDGED),
        (["raise", "clear", "acknowledge", "reset"], True, S.NORMAL),
        (["raise", "clear", "reset"], True, S.RETURNED_UNACKNOWLEDGED),
        (["raise", "acknowledge", "clear", "raise"], True, S.ACTIVE_UNACKNOWLEDGED),
    ],
)
def test_paths_through_the_diagram(stimuli, latching, state):
    assert follow(*stimuli, latching=latching) is state


def test_what_the_data_says_never_fails_and_clearing_never_activates():
    data = [Stimulus.RAISE, Stimulus.ESCALATE, Stimulus.CLEAR]
    for state, stimulus, latching in itertools.product(OWN, data, [False, True]):
        after = transition(state, stimulus, latching=latching)
        assert after in OWN
        if stimulus is Stimulus.RAISE:
            assert after.is_active
        if stimulus is Stimulus.CLEAR:
            assert not after.is_active


@pytest.mark.parametrize("state", [S.ACTIVE_UNACKNOWLEDGED, S.ACTIVE_ACKNOWLEDGED])
def test_a_standing_condition_refuses_reset(state):
    with pytest.raises(CommandNotAllowedError, match="condition is still present"):
        transition(state, Stimulus.RESET, latching=True)


@pytest.mark.parametrize("state", [S.NORMAL, S.RETURNED_UNACKNOWLEDGED])
def test_nothing_to_reset(state):
    with pytest.raises(CommandNotAllowedError, match="nothing to reset"):
        transition(state, Stimulus.RESET, latching=True)


@pytest.mark.parametrize("state", [S.NORMAL, S.ACTIVE_ACKNOWLEDGED, S.LATCHED_ACKNOWLEDGED])
def test_nothing_to_acknowledge(state):
    with pytest.raises(CommandNotAllowedError, match="nothing to acknowledge"):
        transition(state, Stimulus.ACKNOWLEDGE, latching=True)


def test_the_strongest_hold_is_shown():
    assert shown(S.ACTIVE_ACKNOWLEDGED, set()) is S.ACTIVE_ACKNOWLEDGED
    assert shown(S.ACTIVE_ACKNOWLEDGED, {Hold.SHELVED}) is S.SHELVED
    assert shown(S.NORMAL, {Hold.SHELVED, Hold.SUPPRESSED}) is S.SUPPRESSED
    assert shown(S.NORMAL, set(Hold)) is S.OUT_OF_SERVICE


def test_levels_are_ordered_and_named():
    assert Level.NORMAL < Level.ALERT < Level.DANGER
    for level in Level:
        assert Level.of(level.label) is level
