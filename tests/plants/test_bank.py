"""How the answers of the live bank are counted."""

from __future__ import annotations

from dataclasses import replace

from plants.bank import BankSaid, bank_answers, bank_beside, bank_summary, parts_of

SAID = BankSaid(
    case="bank-one",
    geometry="overhung",
    fault="damping_loss",
    snr_db=20,
    without=False,
    false_alarms=0,
    revolutions_before=90.0,
    chances={"damping_loss": 0.95, "unbalance": 0.05},
    fault_said="damping_loss",
    group=("damping_loss",),
    delay=2.0,
    told_delay=1.0,
    onset_error=-0.5,
    predicted=True,
    moved=0.3,
)
PAIR = replace(SAID, fault_said="unbalance", group=("unbalance", "damping_loss"))
NEIGHBOUR = replace(SAID, fault_said="unbalance", group=("unbalance",))
GROUP = replace(SAID, group=("damping_loss", "stiffness_loss"))
WRONG = replace(SAID, fault_said="rub", group=("rub", "stiffness_loss"))
UNSEEN = replace(SAID, fault_said="healthy", group=("healthy",), delay=None)
HEALTHY = replace(UNSEEN, fault="healthy")


def counted(said):
    return [said.right, said.told, said.wrong, said.alone, said.other]


def test_a_name_is_right_told_or_wrong_with_and_without_the_pair_as_one():
    assert counted(SAID) == [True, True, False, True, False]
    assert counted(PAIR) == [True, True, False, False, False]
    assert counted(NEIGHBOUR) == [True, True, False, False, True]
    assert counted(GROUP) == [False, True, False, False, False]
    assert counted(WRONG) == [False, False, True, False, True]
    assert counted(UNSEEN) == [False, False, False, False, False]
    assert HEALTHY.alone


def test_small_changes_count_only_where_all_do():
    small = replace(WRONG, moved=0.05)
    said = [SAID, PAIR, NEIGHBOUR, GROUP, small, HEALTHY]
    said += [replace(one, snr_db=snr) for one in said for snr in (10, 0)]
    header, _, row, *_ = bank_summary(said)
    cells = dict(zip(header.strip("| ").split(" | "), row.strip("| ").split(" | "), strict=True))
    assert cells["right"] == "75.0 %"
    assert cells["told"] == "100.0 %"
    assert cells["wrong"] == "0.0 % of 4"
    assert cells["true of p >= 0.9"] == "100.0 % of 4"
    assert cells["alone"] == "20.0 %"
    assert cells["another"] == "40.0 %"
    assert cells["alone, of predicted"] == "20.0 % of 5"
    assert cells["not seen"] == "0.0 % of 5"
    assert cells["healthy right"] == "100.0 %"
    assert cells["onset off"] == "0.50 rev"
    assert cells["delay ratio"] == "2.00"
    assert "damping loss or unbalance 1" in bank_answers(said, 20)[2]


CRACK = replace(SAID, case="crack", fault="breathing crack", fault_said="unmodelled", group=("unmodelled",))
SOFTER = replace(
    CRACK, fault_said="stiffness_loss", group=("stiffness_loss",), chances={"stiffness_loss": 1.0}
)
MISNAMED = replace(SOFTER, fault="coupled 2X")
ALARM = replace(HEALTHY, case="healthy", false_alarms=1, revolutions_before=700.0)


def test_a_fault_without_a_model_is_misnamed_by_a_sure_name_that_is_not_true_of_it():
    assert [one.misnamed for one in (CRACK, SOFTER, MISNAMED)] == [False, False, True]
    unsure = replace(MISNAMED, chances={"stiffness_loss": 0.5, "static_load": 0.5})
    assert not unsure.misnamed
    assert not replace(MISNAMED, group=("stiffness_loss", "unmodelled")).misnamed


def test_what_a_bank_has_no_mode_of_is_counted_by_itself():
    said = [replace(one, snr_db=snr) for one in (CRACK, SOFTER, MISNAMED, ALARM) for snr in (20, 10, 0)]
    faults = ("unbalance", "damping_loss", "stiffness_loss", "static_load", "rub")
    said += [replace(SAID, snr_db=10, without=True, fault=fault) for fault in faults]
    own, others, without = parts_of([*said, SAID])
    assert (own, len(others), len(without)) == ([SAID], 12, 5)
    rows = bank_beside(others, without)
    assert rows[2] == "| 20 dB | 33.3 % of 3 | 33.3 % | 1.03 (970 rev) |"
    assert rows[8].startswith("| unbalance | 100.0 % | 100.0 % | 0.0 % of 1 |")
    assert rows[10].startswith("| stiffness loss | 0.0 % | 0.0 % | 100.0 % of 1 |")
