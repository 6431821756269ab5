"""``daqsvc fleet report``: changes, missed faults, false alarms and what they cost, from a table made up."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import pytest

from daqsvc.cli import main
from daqsvc.fleet.report import natural
from daqsvc.fleet.results import Results, folder_of
from daqsvc.fleet.table import COLUMNS, recorded_at

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

FAN = "nnnnunnuuu"
"""A day each: a false alarm on the fifth, and an unbalance that is real from the eighth on."""
PUMP = "nnnnnnnn-n"
"""One that could not be judged; a fault that nobody saw."""
WORDS = {"n": "normal", "u": "unbalance", "i": "inner"}


@pytest.fixture
def results(tmp_path: Path) -> Path:
    """Two machines."""
    place = tmp_path / "results"
    for machine, days in (("fan", FAN), ("pump", PUMP)):
        Results(str(place)).add(
            [row(machine, day, code) for day, code in enumerate(days, 1)], folder_of(machine)
        )
    return place


@pytest.fixture
def truth(tmp_path: Path) -> Path:
    """What is known of them."""
    file = tmp_path / "truth.csv"
    file.write_text(
        "machine, fault, first, last\n"
        "fan,unbalance,2026-03-08.npz,\n"
        "pump,crack,2026-03-05,2026-03-07\n"
        "pump,looseness,2027-01-01,\n"
        "mixer,rub,,\n"
    )
    return file


def row(machine: str, day: int, code: str) -> dict[str, Any]:
    file = f"2026-03-{day:02}.npz"
    values = {"machine": machine, "file": file, "recorded": recorded_at(file), "judged": code != "-"}
    if code == "-":
        return {**dict.fromkeys(COLUMNS), **values, "reason": f"{file} is cut"}
    return {**dict.fromkeys(COLUMNS), **values, "verdict": WORDS[code], "group": [WORDS[code]]}


def test_changes_misses_false_alarms_and_cost(verb: Callable[..., Any], results: Path, truth: Path) -> None:
    code, (said,), err = verb("fleet", "report", results, "--truth", truth, "--false-alarm-cost", 2000)
    assert (code, err) == (0, "")
    fan, pump = said["machines"]
    assert fan["changes"] == [
        {"file": "2026-03-01.npz", "before": None, "now": "normal"},
        {"file": "2026-03-05.npz", "before": "normal", "now": "unbalance"},
        {"file": "2026-03-06.npz", "before": "unbalance", "now": "normal"},
        {"file": "2026-03-08.npz", "before": "normal", "now": "unbalance"},
    ]
    assert fan["alarms"] == ["2026-03-05.npz", "2026-03-08.npz"]
    assert fan["false_alarms"] == ["2026-03-05.npz"]
    (unbalance,) = fan["known_faults"]
    assert (unbalance["recordings"], unbalance["alarming"], unbalance["named"]) == (3, 3, 3)
    assert (unbalance["first_alarm"], unbalance["missed"]) == ("2026-03-08.npz", False)
    crack, looseness = pump["known_faults"]
    assert (crack["recordings"], crack["first_alarm"], crack["missed"]) == (3, None, True)
    assert (looseness["recordings"], looseness["missed"]) == (0, False)
    assert pump["not_judged"] == {"2026-03-09.npz is cut": 1}
    fleet = said["fleet"]
    assert (fleet["recordings"], fleet["judged"], fleet["alarms"]) == (20, 19, 2)
    assert (fleet["known_faults"], fleet["missed"], fleet["without_recordings"]) == (3, 1, 1)
    assert fleet["machine_years"] == pytest.approx(20 / 365.25)
    assert (fan["false_alarm_cost"], pump["false_alarm_cost"], fleet["false_alarm_cost"]) == (2000, 0, 2000)
    assert fleet["false_alarms_per_machine_year"] == pytest.approx(365.25 / 20)
    assert fleet["false_alarm_cost_per_machine_year"] == pytest.approx(2000 * 365.25 / 20)
    assert fleet["unknown_machines"] == ["mixer"]


def test_the_text_fits_a_terminal_of_100_columns(
    results: Path, truth: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    long = "x" * 150 + "-2026-03-11.npz"
    told = {**row("fan", 11, "i"), "file": long, "machine": "fan"}
    Results(str(results)).add([told], folder_of("fan"))
    arguments = ["fleet", "report", str(results), "--truth", str(truth), "--false-alarm-cost", "2000"]
    assert main(arguments) == 0
    text = capsys.readouterr().out
    assert max(map(len, text.splitlines())) <= 100
    for part in (
        "unbalance -> inner",
        "pump    crack  2026-03-05 to 2026-03-07, 3 recordings",
        "false alarm",
        "Fleet: 2 machines, 20 of 21 recordings judged",
        "3 known faults, 1 missed, 1 without a recording",
        "1 false alarm costs 2,000; that is 17.4, or 34,786, a machine and year",
        "now     alarms  faults  missed  false  cost",
        "no results of: mixer",
    ):
        assert part in text, text


def test_what_was_not_judged_spoils_no_figure_of_a_year(
    verb: Callable[..., Any], results: Path, truth: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A file without a date that could not be read; a machine none of whose recordings could be."""
    bad = {**row("fan", 9, "-"), "file": "cut.npz", "recorded": None}
    Results(str(results)).add([bad], folder_of("fan"))
    Results(str(results)).add([row("mill", day, "-") for day in range(1, 7)], folder_of("mill"))
    arguments = ("fleet", "report", results, "--truth", truth, "--false-alarm-cost", 2000)
    _, (said,), _ = verb(*arguments)
    assert said["fleet"]["machine_years"] == pytest.approx(20 / 365.25)
    assert said["fleet"]["times_not_known"] == ["mill"]
    _, (said,), _ = verb(*arguments, "--interval", "1d")
    assert said["fleet"]["machine_years"] == pytest.approx(19 / 365.25)
    assert said["fleet"]["times_not_known"] == []
    assert main(list(map(str, arguments))) == 0
    text = capsys.readouterr().out
    assert (
        "1 false alarm costs 2,000; of the machines whose times are known that is 18.3, or 36,525, a machine"
    ) in text
    assert "The time of mill is not known: judged recordings with dates in their names, or --interval" in text


def test_what_false_alarms_cost_is_said_without_any_time(
    results: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    place, truth = tmp_path / "undated", tmp_path / "none.csv"
    truth.write_text("machine,fault\n")
    for machine in ("fan", "pump"):
        rows = [
            {**row(machine, day, code), "file": f"run-{day}.npz", "recorded": None}
            for day, code in enumerate("nuni" if machine == "fan" else "nn")
        ]
        Results(str(place)).add(rows, folder_of(machine))
    assert main(["fleet", "report", str(place), "--truth", str(truth), "--false-alarm-cost", "2000"]) == 0
    text = " ".join(capsys.readouterr().out.split())
    assert "times not known, 2 alarms 0 known faults" in text
    assert "2 false alarms cost 4,000; how many that is a year is not known" in text
    assert main(["fleet", "report", str(results), "--false-alarm-cost", "2000"]) == 0
    assert "What false alarms cost is not known: --truth has" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("fault", "why"),
    [
        (
            "fan,rub,01.03.2026,",
            "line 2: '01.03.2026' is neither a time nor a recording of fan; write a time as",
        ),
        ("fan,rub,,2026-02-31", "'2026-02-31' is neither a time nor a recording of fan"),
        ("fan,rub,2026-03-08T25:00,", "is neither a time nor a recording"),
        ("fan,rub,2026-03-08T10:00+02:00,", "is neither a time nor a recording"),
        (
            "fan,rub,2026-03-08,2026-03-07",
            "first, '2026-03-08', is after last, '2026-03-07'; correct the line",
        ),
        ("fan,rub,2026-03-08.npz,2026-03-07T10:00Z", "is after last"),
        ("fan,rub,2026-03-08.npz,2026-03-07.npz", "is after last"),
        ("mixer,rub,2026-03-08,2026-03-07", "is after last"),
        ("mill,rub,2026-03-08,", "is a time, and no recording of mill has one in its name; name recordings"),
        ("mill,rub,run-10.npz,run-9.npz", "first, 'run-10.npz', is after last, 'run-9.npz'"),
    ],
)
def test_a_bound_that_cannot_be_is_refused(
    verb: Callable[..., Any], results: Path, tmp_path: Path, fault: str, why: str
) -> None:
    undated = [{**row("mill", k, "n"), "file": f"run-{k}.npz", "recorded": None} for k in (9, 10)]
    Results(str(results)).add(undated, folder_of("mill"))
    truth = tmp_path / "bad.csv"
    truth.write_text(f"machine,fault,first,last\n{fault}\n")
    code, said, err = verb("fleet", "report", results, "--truth", truth)
    assert (code, said) == (2, [])
    assert f"--truth {truth}, line 2: " in err
    assert why in err


@pytest.mark.parametrize(
    ("first", "last", "recordings"),
    [
        ("2026-03-04", "2026-03-05", 2),
        ("2026-03-04.npz", "2026-03-05T00:00Z", 2),
        ("2026-03-04T00:01", "2026-03-05T12:00+00:00", 1),
        ("2026-03-04.npz", "2026-03-04.npz", 1),
        ("20260304", "", 7),
        ("", "2026-03-04", 4),
        ("", "", 10),
    ],
)
def test_both_bounds_belong_to_a_fault(
    verb: Callable[..., Any], results: Path, tmp_path: Path, first: str, last: str, recordings: int
) -> None:
    truth = tmp_path / "good.csv"
    truth.write_text(f"machine,fault,first,last\nfan,rub,{first},{last}\n")
    _, (said,), _ = verb("fleet", "report", results, "--truth", truth)
    assert said["machines"][0]["known_faults"][0]["recordings"] == recordings


def test_one_of_a_thing_is_one_and_a_first_verdict_is_no_change(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    Results(str(tmp_path / "results")).add([row("fan", 1, "u")], folder_of("fan"))
    truth = tmp_path / "truth.csv"
    truth.write_text("machine,fault,first,last\nfan,unbalance,,\n")
    assert main(["fleet", "report", str(tmp_path / "results"), "--truth", str(truth)]) == 0
    text = capsys.readouterr().out
    assert "No verdict changed." in text
    assert "none ->" not in text
    assert "Fleet: 1 machine, 1 of 1 recording judged, times not known, 1 alarm\n" in text
    assert "1 known fault, 0 missed" in text


def test_without_truth_nothing_is_called_false(verb: Callable[..., Any], results: Path) -> None:
    _, (said,), _ = verb("fleet", "report", results, "--interval", "1h")
    assert [one["false_alarms"] for one in said["machines"]] == [[], []]
    assert said["fleet"]["false_alarms"] is said["fleet"]["missed"] is None
    assert said["fleet"]["machine_years"] == pytest.approx(19 / 24 / 365.25), "of what was judged"


def test_the_bearings_of_a_machine_count_as_well(verb: Callable[..., Any], tmp_path: Path) -> None:
    rows = [row("fan", day, "n") for day in (1, 2, 3)]
    rows[1].update(bearing_verdict="outer", bearing_group=["outer"])
    rows[2].update(verdict="rub", bearing_verdict="outer")
    Results(str(tmp_path)).add(rows, folder_of("fan"))
    _, (said,), _ = verb("fleet", "report", tmp_path)
    assert [one["now"] for one in said["machines"][0]["changes"]] == ["normal", "outer", "rub and outer"]


def test_a_machine_with_levels_only_alarms_by_them(verb: Callable[..., Any], tmp_path: Path) -> None:
    levels = {2: "alert", 3: "danger", 4: "normal", 5: None}
    rows = [
        {**row("fan", day, "n"), "verdict": None, "group": [], "worst_severity": worst}
        for day, worst in levels.items()
    ]
    rows.append({**row("fan", 6, "n"), "worst_severity": "danger"})
    Results(str(tmp_path / "results")).add(rows, folder_of("fan"))
    truth = tmp_path / "truth.csv"
    truth.write_text("machine,fault,first\nfan,looseness,2026-03-03\n")
    _, (said,), _ = verb("fleet", "report", tmp_path / "results", "--truth", truth)
    (fan,) = said["machines"]
    assert [one["now"] for one in fan["changes"]] == ["alert", "danger", "normal"]
    assert (fan["alarms"], fan["verdict"]) == (["2026-03-02.npz"], "normal")
    assert fan["false_alarms"] == ["2026-03-02.npz"]
    assert [(one["alarming"], one["missed"]) for one in fan["known_faults"]] == [(1, False)]


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("pump,crack\n", "has no column machine; its first line names machine, fault, first, last"),
        ("machine,fault\n,crack\n", "line 2: machine or fault is empty"),
        ('machine,fault\npump,"crack\n', "is no CSV table"),
        (b"machine,fault\n\xff\n", "it is no text in UTF-8"),
        (None, "No such file or directory"),
    ],
)
def test_a_table_of_faults_that_cannot_be_read_is_named(
    verb: Callable[..., Any], results: Path, tmp_path: Path, text: str | bytes | None, why: str
) -> None:
    file = tmp_path / "bad.csv"
    if text is not None:
        file.write_bytes(text if isinstance(text, bytes) else text.encode())
    code, said, err = verb("fleet", "report", results, "--truth", file)
    assert (code, said) == (1, [])
    assert why in err


def test_a_folder_without_results_is_named(verb: Callable[..., Any], tmp_path: Path) -> None:
    code, _, err = verb("fleet", "report", tmp_path / "none")
    assert code == 1
    assert "holds no results; give the folder that daqsvc analyze --cluster wrote [C24]" in err


def test_numbers_in_names_count() -> None:
    assert sorted(["run-10", "run-9", "run-9b", "a"], key=natural) == ["a", "run-9", "run-9b", "run-10"]
