"""What is wrong with ``daqsvc analyze --cluster``, said before anything is begun."""

from __future__ import annotations

import importlib.util
import subprocess
import sys
from typing import TYPE_CHECKING, Any

import pytest
from support.fleet_archives import add_machine, add_recordings, ended, start_analyze

from daqsvc.commands.analyze_fleet import _text, default_results

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path


@pytest.mark.parametrize(
    ("arguments", "why"),
    [
        (["a", "--cluster", "nonsense"], "'nonsense' is no cluster; write local, local:N"),
        (["a", "--cluster", "local:0"], "is no cluster"),
        (
            ["a", "--cluster", "local", "--probes", "x,y"],
            "--probes: the machine files of the archive state this",
        ),
        (["a", "--cluster", "local", "--plot", "p"], "--plot: the machine files"),
        (["a", "b", "--cluster", "local"], "takes one archive, and 2 places are named"),
        (["m.toml", "--cluster", "local"], "m.toml is a machine file"),
        (["a.npz", "--results", "r"], "--results: only with --cluster"),
        (["a.npz", "--verify", "--retry"], "--verify, --retry: only with --cluster"),
    ],
)
def test_options_that_do_not_go_together_are_named(
    analyze: Callable[..., Any], arguments: list[str], why: str
) -> None:
    code, said, err = analyze(*arguments)
    assert (code, said) == (2, [])
    assert why in err


@pytest.mark.parametrize("arguments", [("analyze", "a", "--cluster", "local"), ("fleet", "report", "r")])
def test_a_missing_extra_is_named(
    verb: Callable[..., Any], monkeypatch: pytest.MonkeyPatch, arguments: tuple[str, ...]
) -> None:
    find = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name, *more: None if name == "distributed" else find(name, *more)
    )
    code, _, err = verb(*arguments)
    assert code == 2
    assert err.endswith(
        "the archive of a fleet needs distributed; install them with: pip install 'daqsvc[fleet]' [C12]\n"
    )


def test_an_archive_that_holds_no_machine_is_named(analyze: Callable[..., Any], tmp_path: Path) -> None:
    for place, why in (
        ("none", "cannot be listed: No such file"),
        ("empty", "holds no machine; an archive has"),
    ):
        (tmp_path / "empty").mkdir(exist_ok=True)
        code, _, err = analyze(tmp_path / place, "--cluster", "local:1")
        assert (code, why in err) == (1, True), err
    (tmp_path / "empty" / "photos").mkdir()
    code, _, err = analyze(tmp_path / "empty", "--cluster", "local:1")
    assert (code, "has a machine.toml and recordings/ in it" in err) == (1, True), err
    assert [one.name for one in tmp_path.iterdir()] == ["empty"], "no folder for results is left"


def test_a_place_of_a_store_is_named_as_it_was_given(analyze: Callable[..., Any]) -> None:
    code, _, err = analyze("memory://plant/none", "--cluster", "local:1", "--results", "memory://r")
    assert code == 1
    assert "memory://plant/none cannot be listed: No such file or directory; correct the path" in err


@pytest.mark.parametrize(
    "place", ["arch ive", "arch ive/pump 1", "arch ive/pump 1/new/one", "link", "a/../link"]
)
def test_results_in_the_archive_are_refused(analyze: Callable[..., Any], tmp_path: Path, place: str) -> None:
    archive = tmp_path / "arch ive"
    add_machine(archive, "pump 1")
    (tmp_path / "a").mkdir()
    (tmp_path / "link").symlink_to(archive / "pump 1")
    before = sorted(tmp_path.rglob("*"))
    code, said, err = analyze(archive, "--cluster", "local:1", "--results", tmp_path / place)
    assert (code, said) == (1, [])
    assert err.count("\n") == 1
    assert f"{tmp_path / place} is in the archive {archive}, of which it would become a part; name a" in err
    assert sorted(tmp_path.rglob("*")) == before


@pytest.mark.parametrize(
    ("archive", "results"),
    [
        ("fleet", "fleet-results"),
        ("a b/fleet/", "a b/fleet-results"),
        ("s3://plant/archive/", "s3://plant/archive-results"),
        (".", "/here/fleet-results"),
        ("./", "/here/fleet-results"),
        ("pumps/..", "/here/fleet-results"),
    ],
)
def test_results_are_beside_the_archive(archive: str, results: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("os.getcwd", lambda: "/here/fleet")
    assert default_results(archive) == results


@pytest.mark.integration
def test_a_scheduler_that_is_not_there_is_named_in_time(tmp_path: Path) -> None:
    add_recordings(add_machine(tmp_path / "archive", "pump"), 1)
    run = start_analyze(tmp_path / "archive", "--cluster", "tcp://127.0.0.1:9", connect_s=0.5)
    code, _, err = ended(run)
    assert code == 1
    assert err.startswith("daqsvc analyze: no Dask scheduler answers at tcp://127.0.0.1:9 (")
    assert err.endswith("start one there (dask scheduler), or use --cluster local [C24]\n")
    assert err.count("\n") == 1
    assert [one.name for one in tmp_path.iterdir()] == ["archive"], "no folder for results is left"


def test_one_of_a_thing_is_one() -> None:
    from daqsvc.fleet.campaign import CampaignSummary

    text = _text(CampaignSummary(machines=1, recordings=1, judged=1, others=1), "there")
    assert "1 recording of 1 machine, 1 judged now\n1 file among the recordings is of another kind\n" in text


def test_the_command_line_is_loaded_without_dask() -> None:
    """It is what the service is started by."""
    code = "import sys, daqsvc.cli; daqsvc.cli.parser(daqsvc.cli.commands()); print(*sys.modules, sep='\\n')"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    loaded = {name.split(".")[0] for name in done.stdout.split()}
    assert not loaded & {"dask", "distributed", "fsspec", "pyarrow", "tornado"}
    assert not [name for name in done.stdout.split() if name.startswith("daqsvc.fleet")]
