"""What the innovations say for and against each mode, as the bank has told it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest
from test_findings import looking, said

from daqsvc.history.file import HistoryFile, Series
from daqsvc.history.points import RECORD
from daqsvc.page.charts import LIGHT
from daqsvc.page.present import value_rows
from daqsvc.page.views.all_views import VIEWS

if TYPE_CHECKING:
    from pathlib import Path

VIEW = VIEWS["evidence"]
CHOSEN = {"detector": "rotor-bank", "length": "60"}
LIMITS = {"cusum": 16.0, "cusum.back": 25.0}


def test_evidence_against_the_declared_mode_is_drawn_over_time_with_what_it_takes() -> None:
    statements = [
        said(
            "N",
            t_ns=second * 10**9,
            evidence={"cusum.F1": 2.0 * second, "lead.F1": 24.0 - second},
            thresholds=LIMITS,
        )
        for second in range(8)
    ]
    live = looking(*statements)
    shown = VIEW.shown(live, CHOSEN)
    drawn = shown.sources["evidence"]
    assert drawn["t"] == pytest.approx(np.arange(-7.0, 1.0))
    assert drawn["m1"] == pytest.approx(2.0 * np.arange(8)), "F1 is the second mode"
    assert drawn["m0"] == pytest.approx(np.zeros(8)), "nothing speaks against what is declared"
    assert shown.sources["limits"]["y"] == [16.0, 25.0]
    rows = {name: value for name, value, _ in shown.rows}
    assert rows["declared"] == "N"
    assert (rows["for F1 against it"], rows["it leads F1 by"]) == ("14.0", "17.0")
    [figure] = VIEW.figures(live, CHOSEN, LIGHT)
    assert "rotor-bank" in figure.label


def test_without_a_bank_it_says_so() -> None:
    live = looking(said("alert", evidence={}, probabilities={}))
    assert "no bank of observers" in VIEW.why_not(live)
    assert next(choice.options for choice in VIEW.choices(live)) == {}


def levels(quality: str = "good", **others: object) -> dict[str, object]:
    plain = said(
        "alert",
        detector="levels/left",
        sensors=["left"],
        probabilities={},
        statistics={"rms": 41.3, "mean": 3.2},
        units={"rms": "um", "mean": "um"},
        thresholds={"rms.alert": 40.0, "rms.danger": 60.0},
        quality=quality,
    )
    return plain | others


def test_present_values_stand_with_their_limits_and_the_state_of_the_sensor() -> None:
    rows = value_rows(looking(levels(), said("N", sensors=["left", "right", "key"], severity="normal")))
    left, right, key = rows.split("</tr>")[:3]
    assert "rms 41.3 um (alert 40, danger 60)<br>mean 3.2 um" in left
    assert ">alert</span>" in left
    assert "<td>OK</td>" in left
    assert "see the detectors below" in right
    assert "key" in key


@pytest.mark.parametrize("severity", ["normal", "danger"])
def test_a_sensor_without_a_value_has_no_level_but_one_that_is_held(severity: str) -> None:
    nothing = levels("missing", severity=severity, statistics={}, units={}, reason="no values came")
    [line] = [one for one in value_rows(looking(nothing)).split("</tr>") if "<td>left</td>" in one]
    assert "no value" in line
    assert "missing: no values came" in line
    assert ('class="level' in line) == (severity == "danger")


def test_a_value_with_zones_says_in_which_it_is_and_a_phase_how_far_it_is_off() -> None:
    at = {"zone_b": 1.4, "zone_c": 2.8, "zone_d": 4.5}
    asked = levels(
        statistics={"velocity_rms": 2.8, "1x_phase_lag": 20.0},
        units={"velocity_rms": "mm/s", "1x_phase_lag": "deg"},
        thresholds={f"velocity_rms.{zone}": begins for zone, begins in at.items()}
        | {"velocity_rms.alert": 2.8, "1x_phase_lag.alert": 25.0, "1x_phase_lag.reference": 350.0},
    )
    rows = value_rows(looking(asked))
    assert "velocity_rms 2.8 mm/s (zone C of ISO 20816-3, alert 2.8)" in rows
    assert "1x_phase_lag 20 deg (30 deg from 350, alert 25)" in rows


def test_a_sensor_that_is_not_ok_says_why_whoever_has_found_it() -> None:
    doubt = said("N", sensors=["left", "right"], quality="not_ok", reason="the gap voltage is -1 V")
    rows = value_rows(looking(levels(), doubt))
    assert "not OK: the gap voltage is -1 V" in rows.split("</tr>")[0]
    assert "no detector measures it" in rows.split("</tr>")[2]


def test_views_of_a_detector_stay_while_its_data_are_missing() -> None:
    missing = said(
        "N", t_ns=10**9, probabilities={}, evidence={}, quality="missing", reason="no samples for 2 s"
    )
    live = looking(said("N"), missing)
    for name in ("modes", "evidence"):
        view = VIEWS[name]
        assert view.why_not(live) == ""
        assert view.choices(live)[0].options == {"rotor-bank": "rotor-bank"}
        shown = view.shown(live, CHOSEN)
        assert shown.note == "no samples for 2 s"
        assert len(shown.sources[name]["t"]) == 1, "what was told before"


def test_probabilities_begin_with_what_the_history_knows(tmp_path: Path) -> None:
    now_s = 1_800_000_000
    live = looking(*(said("N", t_ns=(100 + second) * 10**9) for second in range(3)))
    live.wall_ns_at_0 = (now_s - 100) * 10**9
    live.history = tmp_path / "history.sqlite"
    points = np.array([(now_s - 20 + k, 1, 0.25, 0.25, 0.25) for k in range(25)], RECORD)
    file = HistoryFile(live.history)
    file.write({Series("rig", "rotor-bank", "probabilities", "F1", ""): points})
    file.close()
    shown = VIEWS["modes"].shown(live, CHOSEN).sources["modes"]
    assert shown["t"] == pytest.approx(np.arange(-22.0, 1.0)), "each moment once, the history first"
    assert shown["m1"][:20] == pytest.approx(np.full(20, 0.25))
    assert shown["m1"][20:] == pytest.approx(np.full(3, 0.02)), "what was told since"
    assert np.isnan(shown["m0"][:20]).all(), "nobody has written that one down"
    short = VIEWS["modes"].shown(live, CHOSEN | {"length": "10"}).sources["modes"]
    assert short["t"].min() >= -10.0
