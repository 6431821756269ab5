"""What an operator reads when a bearing is damaged."""

from __future__ import annotations

import pytest

from daqsvc.alarms.rules import Circumstances, DiagnosisRule
from daqsvc.diagnosis.record import Diagnosis

BALL = "damage of a rolling element"


@pytest.mark.parametrize(
    ("decision", "group", "where", "words"),
    [
        ("inner", (), "drive-end", "bearing finds damage of the inner race at drive-end"),
        ("outer", (), "fan-end", "bearing finds damage of the outer race at fan-end"),
        ("ball", (), "fan-end", "bearing finds damage of a rolling element at fan-end"),
        (
            "inner",
            ("inner", "ball"),
            "de",
            f"bearing finds damage of the inner race at de, not told apart from {BALL}",
        ),
        (
            "inner_or_outer",
            ("inner", "outer"),
            "fan-end",
            "bearing finds damage of the inner or outer race at fan-end",
        ),
        (
            "inner_or_outer",
            ("inner", "outer", "ball"),
            "",
            f"bearing finds damage of the inner or outer race, not told apart from {BALL}",
        ),
        ("changed", (), "", "bearing finds a change, its cause not yet known"),
    ],
)
def test_the_alarm_says_what_is_damaged_and_where(decision, group, where, words) -> None:
    diagnosis = Diagnosis(
        machine="motor",
        detector="bearing",
        t_ns=0,
        stream="housing",
        first_index=0,
        end_index=1,
        decision=decision,
        changed=True,
        severity="alert",
        group=group,
        where=where,
    )
    found = DiagnosisRule("bearing-damage", "bearing").watch().find(diagnosis, Circumstances())
    assert found is not None
    assert found.sentence == words
