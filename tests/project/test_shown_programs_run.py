"""Lines of other programs that pages show, run in folders of their own: git, cp, apt, Dask, Mosquitto."""

from __future__ import annotations

import contextlib
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from project.test_shown_programs import ALLOWED, RUN_HERE, others
from support.brokers import Mosquitto, mosquitto_program
from support.fleet_archives import add_machine, add_recordings
from support.paths import ROOT
from support.ports import LOOPBACK, free_port
from support.snippets import documented
from support.waiting import PATIENCE_S

if TYPE_CHECKING:
    from collections.abc import Iterator

pytestmark = [pytest.mark.integration, pytest.mark.sources]
FILES = {"cp", "install", "mkdir", "rm", "sed"}
GIT = {
    "GIT_CONFIG_GLOBAL": os.devnull,
    "GIT_CONFIG_SYSTEM": os.devnull,
    **{f"GIT_{who}_{what}": "ann@example" for who in ("AUTHOR", "COMMITTER") for what in ("NAME", "EMAIL")},
}


def block(page: str, begin: str) -> list[str]:
    """The commands of the block of a page that begins with some words."""
    [found] = [one for one in documented() if one.page.name == page and one.text.startswith(begin)]
    return found.commands


def shell(command: str, folder: Path, **environment: str) -> str:
    """What a command shows that a shell runs; it must not fail."""
    done = subprocess.run(
        ["bash", "-ec", command],
        cwd=folder, env={**os.environ, **environment}, check=False, timeout=PATIENCE_S, text=True,
        stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
    )  # fmt: skip
    assert done.returncode == 0, f"{command}: {done.stdout}"
    return done.stdout


def test_what_is_run_here_is_in_the_list() -> None:
    lines = {line for line, why in ALLOWED.items() if why == RUN_HERE}
    assert {words.split()[0] for words in lines} == {
        *FILES,
        "systemctl",
        "systemd-sysusers",
        "git",
        "cd",
        "sha256sum",
        "apt-get",
        "dask",
    } | {
        "mosquitto_sub",
        "python3",
    }


def test_the_steps_of_a_release_run(tmp_path: Path) -> None:
    """In a repository with one file; `make dist` has tests of its own."""
    here = tmp_path / "daqsvc"
    here.mkdir()
    (here / "file").write_text("old")
    shell("git init -qb main && git add file && git commit -qm first", here, **GIT)
    (here / "file").write_text("new")
    for command in block("release.md", "git commit"):
        shell(command, here, **GIT)
    clone, make, sums = block("release.md", "git clone")
    assert make == "make dist"
    shell(clone, here, **GIT)
    made = tmp_path / "release"
    assert (made / "file").read_text() == "new"
    (made / "dist").mkdir()
    for name in ("a.whl", "a.json"):
        (made / "dist" / name).write_text(name)
    shell(sums, made)
    assert len((made / "dist" / "SHA256SUMS").read_text().splitlines()) == 2
    contributing = tmp_path / "new"
    contributing.mkdir()
    [line] = [one for one in block("CONTRIBUTING.md", "git clone URL") if "git clone" in one]
    assert shell(f"{line.replace('URL', f'{here}')} && pwd", contributing, **GIT).endswith("/daqsvc\n")


def test_lines_that_change_files_run_below_another_root(tmp_path: Path) -> None:
    for folder in ("etc/daqsvc", "etc/systemd/system", "var/lib/daqsvc"):
        (tmp_path / folder).mkdir(parents=True)
    for name in ("pump", "fan"):
        (tmp_path / f"etc/daqsvc/{name}.toml").write_text('directory = "/var/lib/daqsvc"\n')
    lines = [line for _, line, words in others() if words[0] in FILES]
    assert {line.split()[0] for line in lines} == FILES
    for line in sorted(lines, key=lambda line: line.startswith("rm ")):
        shell(re.sub(r"(?<= )/(?=etc/|var/)", f"{tmp_path}/", line), ROOT)
        for name in re.findall(r"/(etc/daqsvc/\w+\.toml)$", line):
            assert f"/var/lib/daqsvc/{Path(name).stem}" in (tmp_path / name).read_text()
    kept = sorted(f"{file.relative_to(tmp_path)}" for file in tmp_path.rglob("*") if file.is_file())
    assert kept == ["etc/systemd/system/daqsvc@.service", "etc/sysusers.d/daqsvc.conf"]
    if shutil.which("systemctl") is None or shutil.which("systemd-sysusers") is None:
        pytest.skip("there is no systemd on this computer")
    shell(f"systemd-sysusers --root={tmp_path}", ROOT)
    assert (tmp_path / "etc/passwd").read_text().startswith("daqsvc:")
    for line in {line for _, line, words in others() if words[:2] == ["systemctl", "enable"]}:
        # It is not started: that is for the guest.
        shell(line.replace("systemctl", f"systemctl --root={tmp_path}").replace(" --now", ""), ROOT)
        unit = tmp_path / f"etc/systemd/system/multi-user.target.wants/{line.split()[-1]}.service"
        assert unit.is_symlink()


def test_debian_has_what_is_installed_from_it() -> None:
    if shutil.which("apt-get") is None or "Candidate" not in shell("apt-cache policy make", ROOT):
        pytest.skip("this computer has no lists of packages (apt-get update)")
    [line] = [line for _, line, words in others() if words[0] == "apt-get"]
    for package in line.split()[2:]:
        assert f"{package}" in shell(f"apt-get --simulate install {package}", ROOT)
    shell(line.replace("apt-get", "apt-get --simulate"), ROOT)


@pytest.mark.mosquitto
def test_the_status_of_a_box_is_read_as_the_page_shows(tmp_path: Path) -> None:
    mosquitto_program("mosquitto_sub", "mosquitto-clients")
    broker = Mosquitto(tmp_path)
    broker.start()
    try:
        line = block("write-a-driver.md", "mosquitto_sub")[0]
        at = f"-h {LOOPBACK} -p {broker.port}"
        status = json.dumps({"box": "edge-1"})
        shell(f"mosquitto_pub {at} -r -q 1 -t daqsvc/lab/edge-1/status -m '{status}'", tmp_path)
        assert json.loads(shell(line.replace(f"-h {LOOPBACK}", at), tmp_path)) == {"box": "edge-1"}
    finally:
        broker.stop()


@contextlib.contextmanager
def running(*words: str, folder: Path) -> Iterator[None]:
    """A program of Dask, for as long as it is needed."""
    with subprocess.Popen(
        [sys.executable, "-m", *words],
        cwd=folder, env={**os.environ, "PYTHONPATH": f"{ROOT}"}, start_new_session=True,
        stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
    ) as process:  # fmt: skip
        try:
            yield
        finally:
            process.terminate()
            try:
                process.wait(PATIENCE_S)
            except subprocess.TimeoutExpired:
                os.killpg(process.pid, 9)


@pytest.mark.long
def test_a_cluster_that_is_started_as_the_page_shows_judges_an_archive(tmp_path: Path) -> None:
    add_recordings(add_machine(tmp_path / "archive", "pump"), 2)
    port = free_port()
    own = {"10.0.0.5": LOOPBACK, "8786": f"{port}"}
    scheduler, worker = (
        [re.sub("|".join(own), lambda match: own[match[0]], word) for word in shlex.split(line)]
        for line in block("fleet.md", "dask scheduler")
    )
    with (
        running(*scheduler, "--port", f"{port}", "--dashboard-address", f"{LOOPBACK}:0", folder=tmp_path),
        running(*worker, folder=tmp_path),
    ):
        said = shell(
            f"{sys.executable} -m daqsvc analyze archive --cluster tcp://{LOOPBACK}:{port}",
            tmp_path,
            PYTHONPATH=f"{ROOT}",
        )
    assert "2 recordings of 1 machine, 2 judged now" in said
