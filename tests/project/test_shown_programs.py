"""Every block of the pages is one that something checks, and every line of another program is known here.

What runs the lines of daqsvc is test_shown_commands.py; what reads TOML, JSON and Python, test_snippets.py.
"""

from __future__ import annotations

import os
import re
import shlex
import shutil
import subprocess
import sys
import tomllib
from collections import Counter
from typing import TYPE_CHECKING

import pytest
import yaml
from project.test_snippets import ALL, EXAMPLES, OURS, SHOWN, TESTED, objects
from support.paths import ROOT
from support.prometheus_programs import program
from support.snippets import PAGES

if TYPE_CHECKING:
    from pathlib import Path

    from support.snippets import Snippet

pytestmark = [pytest.mark.integration, pytest.mark.sources]
HIL = "installs the package in a guest: tests/hil/test_package.py, tests/project/test_deb.py"
UNIT = "runs the unit under systemd in a guest: tests/hil/test_systemd.py"
RUN_HERE = "tests/project/test_shown_programs_run.py"
INSTALL = "tests/project/test_install_docs.py"
INGEST = "tests/publish/mqtt/test_postgresql_ingest.py"
PIP = "tests/project/test_shown_pip.py"
ALLOWED = {
    "apt install './daqsvc_*.deb'": HIL,
    "apt install --allow-downgrades ./daqsvc_OLDER_amd64.deb": HIL,
    "apt remove daqsvc": HIL,
    "apt purge daqsvc": HIL,
    "rm -r /etc/daqsvc /var/lib/daqsvc": RUN_HERE,
    "apt-get install make git python3.11-venv debhelper": RUN_HERE,
    "systemctl enable --now daqsvc@pump": HIL,
    "systemctl enable --now daqsvc@fan": RUN_HERE,
    "systemctl daemon-reload": UNIT,
    "systemctl status --lines 0 daqsvc@pump": UNIT,
    "install -D -m 644 config/systemd/daqsvc.sysusers.conf /etc/sysusers.d/daqsvc.conf": RUN_HERE,
    "systemd-sysusers": RUN_HERE,
    "cp config/systemd/daqsvc@.service /etc/systemd/system/": RUN_HERE,
    "mkdir -p /etc/daqsvc": RUN_HERE,
    "sed -i 's|\"/var/lib/daqsvc\"|\"/var/lib/daqsvc/pump\"|' /etc/daqsvc/pump.toml": RUN_HERE,
    "sed -i 's|\"/var/lib/daqsvc\"|\"/var/lib/daqsvc/fan\"|' /etc/daqsvc/fan.toml": RUN_HERE,
    "pip install --require-hashes -r requirements.lock -r requirements-build.lock": PIP,
    "pip install --no-deps --no-build-isolation .": PIP,
    "pip install 'daqsvc[fleet]'": PIP,
    "pip install 'psycopg[binary]' paho-mqtt": PIP,
    "python3.11 -m venv /opt/daqsvc": PIP,
    "/opt/daqsvc/bin/pip install --require-hashes -r requirements-service.lock": PIP,
    "/opt/daqsvc/bin/pip install --no-deps 'dist/daqsvc-*.whl'": PIP,
    "python3.11 -m venv /tmp/try": PIP,
    "/tmp/try/bin/pip install --require-hashes -r requirements.lock": PIP,  # noqa: S108 - as it is shown
    "/tmp/try/bin/pip install --no-deps 'dist/*.whl'": PIP,  # noqa: S108
    ".venv/bin/pip install -e /path/to/package": "tests/project/test_example_wheels.py",
    ". .venv/bin/activate": INSTALL,
    "git clone URL": RUN_HERE,
    "git commit -am 'Release 0.1.0' -m 'What it is for, in a sentence or two.'": RUN_HERE,
    "git tag -a v0.1.0 -m 'daqsvc 0.1.0'": RUN_HERE,
    "git clone --branch v0.1.0 . ../release": RUN_HERE,
    "cd daqsvc": RUN_HERE,
    "cd ../release": RUN_HERE,
    "cd dist": RUN_HERE,
    "sha256sum '*.whl' '*.json' '>' SHA256SUMS": RUN_HERE,
    "ip link set can0 up type can bitrate 500000 dbitrate 2000000 fd on":
        "needs an adapter for CAN FD; ip reads it here; without FD it runs in tests/hil/test_vcan_shown.py",
    "candump can0": "tests/hil/test_vcan_shown.py",
    "dask scheduler --host 10.0.0.5": RUN_HERE,
    "dask worker tcp://10.0.0.5:8786 --nworkers 8 --nthreads 1": RUN_HERE,
    "psql plant -f config/postgresql/schema.sql": INGEST,
    "python config/postgresql/ingest.py --broker broker.plant --id ingest-1": INGEST,
    "mosquitto_sub -h 127.0.0.1 -t daqsvc/lab/edge-1/status -C 1": RUN_HERE,
    "python3 -m json.tool": RUN_HERE,
}  # fmt: skip
"""The lines of other programs, each with what runs it or why nothing does. A new line is put here by hand."""
HELP = {
    "systemctl": ["systemctl", "--help"],
    "mosquitto_sub": ["mosquitto_sub", "--help"],
    "pip": [sys.executable, "-m", "pip", "install", "--help"],
    "apt": ["apt", "--help"],
}
"""What shows the options of programs, where they are installed."""
HAVE_MAN = {"--allow-downgrades", "-h"}
INGESTED = ("CREATE ROLE daqsvc_ingest LOGIN;", "SELECT create_hypertable(", "persistence true")
"""How blocks of docs/postgresql.md begin that tests/publish/mqtt/test_postgresql_ingest.py runs."""
TERMINAL = {
    ("README.md", "$ systemctl status"): "of systemd: tests/hil/test_systemd.py reads the status of the unit",
    ("README.md", "daqsvc/     the service"): "drawing",
    ("docs/fleet.md", "ARCHIVE/"): "drawing",
    ("docs/fleet.md", "machine,fault,first,last"): "tests/fleet/test_fleet_report.py has such a file",
    (
        "docs/write-a-driver.md",
        "[project.entry-points.",
    ): "tests/commands/test_new_kinds.py has such an entry point",
}
"""What stands in a terminal or a drawing and is no output of a line of daqsvc: by page and first words."""
OUTPUT = {
    ("README.md", "run.npz: "), ("README.md", "105.mat: "), ("README.md", "run-up.npz: "),
    ("docs/analyze.md", "105.mat: "), ("docs/commands.md", "LEVEL "),
    ("docs/status.md", "virtual-rig "), ("docs/modbus.md", "Channels of transmitter"),
}  # fmt: skip
"""Output of the line above it."""
SECTION = re.compile(r"^(?:scrape_configs|rule_files):", re.MULTILINE)


def others() -> list[tuple[str, str, list[str]]]:
    """The lines of other programs than daqsvc and make."""
    return [
        (name, shlex.join(words), words)
        for name, words in SHOWN
        if words[0].rpartition("/")[2] not in {"daqsvc", "make"}
    ]


def kinds(block: Snippet) -> list[str]:
    """What checks a block; there has to be one."""
    page = f"{block.page.relative_to(ROOT)}"
    first = block.text.lstrip("\n")
    known = [key for key in (*TERMINAL, *OUTPUT) if key[0] == page and first.startswith(key[1])]
    ours = [words for name, words in OURS if name == block.name]
    found = {
        "allowed": [block.why_not_run, any(key in TERMINAL for key in known)],
        "made from the source": [page == "docs/reference/verbs.md" and first.startswith("daqsvc ")],
        "is a tested file": [block.text.strip() in EXAMPLES],
        "parsed with schema": [
            block.language == "toml",
            block.language == "json" and all('"schema":' in one for one in objects(block.text)),
        ],
        "executed": [
            block.language == "python",
            page == "docs/postgresql.md" and first.startswith(INGESTED),
            block.language == "yaml" and SECTION.search(block.text),
        ],
        "lines of daqsvc": [block.language in {"", "sh"} and (ours or first.startswith("daqsvc "))],
        "of other programs": [block.language == "sh" and block.commands and not ours],
        "output of the lines above": [any(key in OUTPUT for key in known)],
    }
    kinds = [kind for kind, why in found.items() if any(why)]
    # The first that applies says more than the language does.
    return (
        kinds[:1] if kinds and kinds[0] in {"allowed", "made from the source", "is a tested file"} else kinds
    )


@pytest.mark.parametrize("block", ALL, ids=lambda block: block.name)
def test_a_block_is_checked_in_one_way(block: Snippet) -> None:
    assert len(kinds(block)) == 1, kinds(block)


def test_all_blocks_are_counted() -> None:
    count = Counter(kind for block in ALL for kind in kinds(block))
    print(count)  # noqa: T201 - shown by pytest -s
    assert count.total() == len(ALL)
    assert count["allowed"] <= 6


@pytest.mark.parametrize("page", PAGES, ids=lambda page: f"{page.relative_to(ROOT)}")
def test_no_fence_is_overlooked(page: Path) -> None:
    text = page.read_text("utf-8")
    assert "~~~" not in text
    if page.is_relative_to(ROOT / "docs" / "tutorials"):
        return
    own = [block for block in ALL if block.page == page]
    rest = re.sub(r"```\{include\} \S+\n```", "", text)
    for block in own:
        for line in block.text.splitlines():
            rest = rest.replace(line, "", 1) if "```" in line else rest
    assert len(re.findall(r"(?m)^ *```", rest)) == 2 * len(own)


@pytest.mark.parametrize(("name", "line"), [one[:2] for one in others()])
def test_a_line_of_another_program_is_known(name: str, line: str) -> None:
    assert line in ALLOWED, f"{name}: say in ALLOWED what runs it, or why nothing does"


def test_every_line_that_is_allowed_is_shown() -> None:
    assert set(ALLOWED) - {line for _, line, _ in others()} == set()


@pytest.mark.parametrize("command", HELP)
def test_options_are_those_of_the_program(command: str) -> None:
    if shutil.which(HELP[command][0]) is None:
        pytest.skip(f"there is no {command} on this machine")
    done = subprocess.run(HELP[command], check=False, capture_output=True, text=True)
    known = done.stdout + done.stderr
    for name, _, words in others():
        if words[0].rpartition("/")[2] == command:
            for option in {word for word in words if re.match(r"--?[a-zA-Z]", word)} - HAVE_MAN:
                assert re.search(rf"(?<![\w-]){re.escape(option)}\b", known), (name, option)
            if command in {"systemctl", "apt"}:
                assert re.search(rf"(?m)^ +{re.escape(words[1])}\b", known) or words[1] == "purge", (
                    name,
                    words,
                )


def test_ip_understands_what_is_shown() -> None:
    """All of it but the adapter: the kernel refuses it for the loopback interface, which is up anyway."""
    ip = shutil.which("ip", path=f"{os.environ['PATH']}:/usr/sbin:/sbin")
    if ip is None:
        pytest.skip("there is no ip on this machine (apt-get install iproute2)")
    shown = [words for _, _, words in others() if words[0] == "ip"]
    assert shown
    for words in [*shown, ["ip", "link", "set", "can0", "up", "tipe", "can", "bitrate", "500000"]]:
        command = [ip, *("lo" if word == "can0" else word for word in words[1:])]
        answer = subprocess.run(command, check=False, capture_output=True, text=True).stderr
        assert answer.startswith("RTNETLINK answers: Operation not") == (words in shown), answer


def test_what_pip_installs_is_there() -> None:
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]["optional-dependencies"]
    for name, line, _ in others():
        if "pip install" in line:
            for extra in re.findall(r"daqsvc\[(\w+)\]", line):
                assert extra in extras, name
            for file in re.findall(r"-r (\S+)", line):
                assert (ROOT / file).is_file(), name


def test_make_can_make_what_is_shown() -> None:
    for name, words in SHOWN:
        if words[0] == "make":
            done = subprocess.run(
                ["make", "--dry-run", *words[1:]], cwd=ROOT, check=False, capture_output=True, text=True
            )
            assert done.returncode == 0, (name, words, done.stderr)


@pytest.mark.parametrize(
    "block", [one for one in ALL if one.language == "yaml"], ids=lambda block: block.name
)
def test_the_configuration_of_prometheus_is_one(block: Snippet, tmp_path: Path) -> None:
    assert isinstance(yaml.safe_load(block.text), dict)
    for rules in (ROOT / "config" / "prometheus").glob("*.yml"):
        shutil.copy(rules, tmp_path)
    (tmp_path / "prometheus.yml").write_text(block.text)
    done = subprocess.run(
        [program("promtool"), "check", "config", str(tmp_path / "prometheus.yml")],
        check=False, capture_output=True, text=True,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr


def test_tests_that_are_named_are_there() -> None:
    for reason in (*ALLOWED.values(), *TERMINAL.values(), *TESTED.values()):
        for file in re.findall(r"tests/[\w/]+\.py", reason):
            assert (ROOT / file).is_file(), reason
