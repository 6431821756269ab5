"""The files of config/: each can be loaded, begins with what it is, and comes with an installed package."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tomllib

import pytest
from support.paths import ROOT

from daqsvc.cli import main
from daqsvc.commands.example import examples
from daqsvc.settings import load_machine_file
from sim_hw.scenario import load_any_scenario

pytestmark = pytest.mark.integration
CONFIG = ROOT / "config"
# test_systemd_unit.py, test_metrics.py and test_postgresql_ingest.py have the others.
ELSEWHERE = {"systemd", "prometheus", "postgresql", "__pycache__"}
FILES = sorted(path for path in CONFIG.rglob("*") if path.is_file() and path.parent.name not in ELSEWHERE)


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.name)
def test_every_file_of_config_is_loaded_by_what_reads_it(path):
    assert path.suffix in {".toml", ".dbc"}
    if path.parent.name == "machines":
        assert load_machine_file(path).warnings == ()
    elif path.parent.name == "scenarios":
        title = tomllib.loads(path.read_text(encoding="utf-8"))["title"]
        assert load_any_scenario(path).title == title
    else:
        assert path.parent.name == "devices"
        assert any(path.name in example.devices for example in examples().values())


def test_the_examples_are_listed_with_what_they_are(capsys):
    assert main(["example"]) == 0
    listed = capsys.readouterr().out
    for path in FILES:
        if path.suffix == ".toml":
            assert f"  {path.stem} " in listed
    for example in examples().values():
        assert len(example.about) > 10
        assert example.about in listed


def test_an_example_is_printed_as_it_is(capsys):
    assert main(["example", "laval-rig"]) == 0
    assert capsys.readouterr().out == (CONFIG / "machines" / "laval-rig.toml").read_text(encoding="utf-8")


@pytest.mark.parametrize("name", sorted(examples()))
def test_an_example_is_copied_with_the_files_that_it_needs(tmp_path, capsys, name):
    assert main(["example", name, "--out", str(tmp_path)]) == 0
    copy = tmp_path / f"{name}.toml"
    assert str(copy) in capsys.readouterr().out
    if examples()[name].folder == "machines":
        assert load_machine_file(copy).warnings == ()
    # What is there already is not lost.
    copy.write_text("mine")
    assert main(["example", name, "--out", str(copy)]) == 1
    assert "there already" in capsys.readouterr().err
    assert copy.read_text() == "mine"


def test_two_examples_may_have_a_file_in_common(tmp_path, capsys):
    first, second, third = (tmp_path / f"{name}.toml" for name in ("first", "second", "third"))
    dbc = tmp_path / "triaxial-accelerometer.dbc"
    assert main(["example", "dbc-triaxial", "--out", f"{first}"]) == 0
    assert capsys.readouterr().out.splitlines() == [f"{first}", f"{dbc}"]
    assert main(["example", "replay-fan", "--out", f"{second}"]) == 0
    assert capsys.readouterr().out.splitlines() == [f"{second}"]
    assert load_machine_file(second).warnings == ()
    # One that says something else is in the way: then nothing is written.
    dbc.write_text("mine")
    assert main(["example", "replay-fan", "--out", f"{third}"]) == 1
    assert f"{dbc} is there already" in capsys.readouterr().err
    assert not third.exists()


def test_without_a_name_nothing_is_written(tmp_path, capsys):
    assert main(["example", "--out", f"{tmp_path / 'x.toml'}"]) == 2
    said = capsys.readouterr()
    assert said.out == ""
    assert "name it before --out" in said.err


def test_what_cannot_be_had_is_said_in_a_line(tmp_path, capsys):
    assert main(["example", "laval-rg"]) == 2
    assert 'did you mean "laval-rig"?' in capsys.readouterr().err
    assert main(["example", "laval-rig", "--out", str(tmp_path / "no" / "m.toml")]) == 1
    assert "No such file or directory" in capsys.readouterr().err
    assert main(["check", str(tmp_path / "m.toml")]) == 2
    assert "daqsvc example" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ([], "daqsvc: the following arguments are required: VERB; see daqsvc --help"),
        (["check"], "daqsvc check: the following arguments are required: FILE; see daqsvc check --help"),
        (["run", "m.toml", "--stroe", "x"], "see daqsvc"),
        (["analyze", "--no-such"], "see daqsvc"),
        (["sim"], "see daqsvc sim --help"),
        (["demo", "--speed", "fast"], "see daqsvc demo --help"),
    ],
)
def test_a_wrong_command_line_is_answered_in_one_line(capsys, arguments, words):
    with pytest.raises(SystemExit) as ended:
        main(arguments)
    assert ended.value.code == 2
    said = capsys.readouterr()
    assert said.out == ""
    assert said.err.count("\n") == 1
    assert words in said.err


@pytest.mark.long
@pytest.mark.timeout(600)
def test_a_wheel_in_an_environment_of_its_own_has_the_examples(tmp_path):
    source = tmp_path / "source"
    source.mkdir()
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source)
    ignored = shutil.ignore_patterns("__pycache__", "*.egg-info")
    for name in ("daqsvc", "drivers", "sim_hw", "config"):
        shutil.copytree(ROOT / name, source / name, symlinks=True, ignore=ignored)
    quiet = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}

    def run(*command, code=0):
        done = subprocess.run(
            list(map(str, command)), cwd=tmp_path, env=quiet, check=False, capture_output=True, text=True
        )
        assert done.returncode == code, done.stderr
        return done

    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check"]
    run(*pip, "wheel", "--no-deps", "--no-build-isolation", "--no-index", "--wheel-dir", tmp_path, source)
    (wheel,) = tmp_path.glob("daqsvc-*.whl")
    run(sys.executable, "-m", "venv", tmp_path / "venv")
    python = tmp_path / "venv" / "bin" / "python"
    run(python, "-m", "pip", "install", "--no-deps", "--no-index", wheel)
    # Its dependencies are those of this environment; daqsvc itself is not, as it comes later in the path.
    (packages,) = (tmp_path / "venv" / "lib").glob("python*/site-packages")
    (here,) = [path for path in sys.path if path.endswith("site-packages")]
    (packages / "dependencies.pth").write_text(here)
    shutil.rmtree(source)
    daqsvc = tmp_path / "venv" / "bin" / "daqsvc"
    listed = run(daqsvc, "example").stdout
    for path in FILES:
        if path.suffix == ".toml":
            assert f"  {path.stem} " in listed
    written = run(daqsvc, "example", "dbc-triaxial", "--out", tmp_path).stdout.splitlines()
    assert written == [str(tmp_path / "dbc-triaxial.toml"), str(tmp_path / "triaxial-accelerometer.dbc")]
    assert "Machine  fan" in run(daqsvc, "check", "dbc-triaxial.toml").stdout
    assert "daqsvc example" in run(daqsvc, "check", "absent.toml", code=2).stderr
