"""The command line, run as a person or as systemd runs it."""

from __future__ import annotations

import re
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from support.examples import first_of
from support.given_codes import had
from support.paths import ROOT
from support.ports import free_port

from daqsvc import service as service_module
from daqsvc.cli import main
from daqsvc.commands import process_guard
from daqsvc.commands.sniff import SniffCommand

pytestmark = pytest.mark.integration
CONFIG = ROOT / "config" / "machines"
README = CONFIG.parents[1] / "README.md"
PROMISED_S = 2.0
"""In which a service stops: systemd is told so."""
PATIENT = "from daqsvc.commands import process_guard\nprocess_guard.STOP_TURNS = 150\n"
PATIENT += "import sys\nfrom daqsvc.cli import main\nsys.exit(main(sys.argv[1:]))"
"""The verb with a guard that gives a slow machine more time; it still ends, with code 4, what hangs."""
PEOPLE = ("alarms", "ack", "reset", "shelve", "unshelve", "bypass", "unbypass")
VERBS = (
    "run",
    "check",
    "reload",
    "snapshot",
    "replay",
    "status",
    "page",
    "account",
    "trend",
    *PEOPLE,
    "analyze",
    "fleet",
    "calibrate",
    "export",
    "detectability",
    "example",
    "sniff",
    "explain",
    "new",
    "record",
    "demo",
    "reproduce",
    "sim",
)


def daqsvc(*arguments: str | Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "daqsvc", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)


@pytest.mark.parametrize("file", sorted(CONFIG.glob("*.toml")), ids=lambda path: path.stem)
def test_check_says_what_it_understood(file: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code = main(["check", str(file)])
    out, err = capsys.readouterr()
    assert (code, err) == (0, "")
    assert max(map(len, out.splitlines())) <= 110


def test_check_tells_every_error_with_file_line_key_value_and_remedy(tmp_path: Path) -> None:
    text = (CONFIG / "laval-rig.toml").read_text()
    text = text.replace("damping_ratio = 0.18 ", 'damping_ratio = "lots" ', 1)
    text = re.sub(r"^interface = ", "interfase = ", text, count=1, flags=re.MULTILINE)
    text = re.sub(r'^stream = "shaft"', 'stream = "shaft2"', text, count=1, flags=re.MULTILINE)
    bad = tmp_path / "bad.toml"
    bad.write_text(text)
    done = daqsvc("check", bad)
    assert done.returncode == 2
    for words in ('= "lots"', "interfase", "did you mean interface", '"shaft2"', "Remedy"):
        assert words in done.stderr
    lines = text.splitlines()
    for key in ('interfase = "socketcan"', 'stream = "shaft2"'):
        number = next(i for i, line in enumerate(lines, 1) if line.startswith(key))
        assert f"{bad}:{number}:" in done.stderr
    assert daqsvc("run", bad).returncode == 2


def test_check_of_a_file_that_is_not_there_says_so(tmp_path: Path) -> None:
    done = daqsvc("check", tmp_path / "none.toml")
    assert done.returncode == 2
    assert "none.toml" in done.stderr
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize("verb", [[], *([verb] for verb in VERBS)])
def test_help_reads_well(verb: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main([*verb, "--help"])
    assert ended.value.code == 0
    out, _ = capsys.readouterr()
    assert out.startswith("usage: daqsvc")
    for line in out.splitlines():
        assert len(line) <= 100


def test_a_verb_does_not_wait_for_the_arguments_of_the_others(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[str] = []
    monkeypatch.setattr(SniffCommand, "add_arguments", lambda *_: asked.append("sniff"))
    assert main(["explain", "F01"]) == 0
    assert asked == []
    with pytest.raises(SystemExit):
        main(["--help"])
    assert asked == ["sniff"]


def test_the_readme_names_every_verb() -> None:
    listed = re.findall(r"^    (\w+)", daqsvc("--help").stdout.split("verbs:")[1], flags=re.MULTILINE)
    assert tuple(listed) == VERBS
    table = README.read_text(encoding="utf-8").split("## The verbs")[1].split("\n## ")[0]
    rows = re.findall(r"^\| (`[^|]*) \|.*\|$", table, flags=re.MULTILINE)
    assert set(re.findall(r"`(\w+)", " ".join(rows))) == set(VERBS)


@pytest.mark.long
@pytest.mark.parametrize("number", first_of(signal.SIGTERM, signal.SIGINT))
def test_run_stops_even_if_the_broker_is_dead(number: int, tmp_path: Path) -> None:
    text = (CONFIG / "laval-rig.toml").read_text()
    text = text.replace('interface = "socketcan"', 'interface = "virtual"')
    text = re.sub(r"^url = .*$", f'url = "mqtt://127.0.0.1:{free_port()}"', text, flags=re.MULTILINE)
    text = re.sub(r"^(ca_file|username|password_file) = .*$", "", text, flags=re.MULTILINE)
    if "insecure" not in text:
        text = re.sub(r"^\[mqtt\]", "[mqtt]\ninsecure = true", text, flags=re.MULTILINE)
    file = tmp_path / "rig.toml"
    file.write_text(text)
    command = [sys.executable, "-c", PATIENT, "run", str(file), "--store", str(tmp_path / "store"), "-v"]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as service:
        assert service.stderr is not None
        said: list[str] = []
        for line in service.stderr:
            said.append(line)
            if "watching laval-rig" in line:
                break
        else:
            pytest.fail("".join(said))
        service.send_signal(number)
        rest = service.stderr.read()
        assert service.wait(60) == 0, rest
    assert "Traceback" not in rest
    assert rest.strip().endswith("stopped")


def test_the_parts_of_a_stop_add_up_to_what_is_promised() -> None:
    """The time itself is no matter for a test: it is that of the machine."""
    assert service_module.STOP_S + service_module.CLOSE_S <= PROMISED_S
    assert process_guard.STOP_TURNS * process_guard.TURN_S + process_guard.CLOSE_S <= PROMISED_S + 1e-9


@pytest.mark.long
def test_run_says_which_device_is_absent_where_that_is_an_error(tmp_path: Path) -> None:
    text = (CONFIG / "laval-rig.toml").read_text()
    text = re.sub(r'^channel = "can0"', 'channel = "no-such-can"\nstart = "error"', text, flags=re.MULTILINE)
    text = re.sub(r'^start = "retry".*$', "", text, flags=re.MULTILINE)
    file = tmp_path / "rig.toml"
    file.write_text(text)
    done = daqsvc("run", file, "--store", tmp_path / "store")
    assert done.returncode == 1
    assert "CAN bus 'can0' (socketcan no-such-can): it cannot be opened: " in done.stderr
    assert "Traceback" not in done.stderr


def test_output_that_cannot_be_written_is_said_in_one_line() -> None:
    command = [sys.executable, "-m", "daqsvc", "check", str(CONFIG / "laval-rig.toml")]
    with Path("/dev/full").open("w") as full:
        done = subprocess.run(
            command, stdout=full, stderr=subprocess.PIPE, text=True, timeout=60, check=False
        )
    assert done.returncode == 1
    assert done.stderr == "daqsvc: No space left on device: the output is not complete [C16]\n"
    had("C16", done.stderr)


def test_a_reader_that_has_had_enough_is_no_error() -> None:
    command = [sys.executable, "-m", "daqsvc", "check", str(CONFIG / "laval-rig.toml")]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        process.stdout.close()
        assert process.stderr.read() == ""
        assert process.wait(60) == 0


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (
            ["alarm", "gearbox.toml"],
            "VERB: invalid choice: 'alarm'; did you mean 'alarms'? (choose from 'run', ",
        ),
        (
            ["trend", "--step", "minutes"],
            "--step: invalid choice: 'minutes'; did you mean 'minute'? (choose from",
        ),
        (
            ["trend", "--step", "xyz"],
            "--step: invalid choice: 'xyz' (choose from 'second', 'minute', 'hour')",
        ),
    ],
)
def test_of_a_verb_or_choice_that_is_misspelt_the_one_that_is_meant_is_named(arguments, words, capsys):
    with pytest.raises(SystemExit):
        main(arguments)
    assert words in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (
            ["ack", "foo", "pump.toml", "--store", "."],
            (
                "argument FILE: not allowed with argument --store; the machine file names the store already: "
                "leave out FILE or --store"
            ),
        ),
        (["trend", "--nope"], "unrecognized arguments: --nope"),
        (["check", "pump.toml", "--nope"], "unrecognized arguments: --nope"),
    ],
)
def test_what_is_wrong_with_arguments_is_told_with_the_verb_and_its_help(arguments, words, capsys):
    with pytest.raises(SystemExit):
        main(arguments)
    verb = f"daqsvc {arguments[0]}"
    assert capsys.readouterr().err == f"{verb}: {words}; see {verb} --help [C01]\n"
