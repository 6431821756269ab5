"""The service has its kernels compiled by another process, and only loads them: that takes less memory."""

from __future__ import annotations

import contextlib
import os
import re
import signal
import subprocess
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from support.machine_files import MOTOR
from support.paths import ROOT
from support.waiting import PATIENCE_S, eventually_blocking

if TYPE_CHECKING:
    from collections.abc import Iterator

pytestmark = [pytest.mark.integration, pytest.mark.long]

KERNELS = """
from daqsvc.kernels import njit
@njit("float64(float64)", cache=True)
def at_once(x):
    return x + 1
@njit(cache=True)
def when_called(x):
    return at_once(x) + 1
"""
USE = """
import logging, os, resource, sys
from daqsvc import kernel_cache, kernel_compiler
from daqsvc.notice import NOTICE
logging.basicConfig(format="%(message)s", level=NOTICE)
kernel_cache.prepare()
compiler = kernel_compiler.compile_apart()
{fault}
from daqsvc import kernels
from numba.core import event
with event.install_recorder("numba:compile") as here:
    import two
    print(two.when_called(1.0), two.at_once(1.0))
print("compiled here:", len(here.buffer) // 2)
compiler.close()
try:
    os.waitpid(-1, os.WNOHANG)
except ChildProcessError:
    print("nobody is left")
"""
MOST_KB = 150_000
"""What a service of one machine may take; some 121 MB, and 205 to 260 MB if it has compiled."""
COMPILING = "compiling kernels for this processor (first start only; takes up to a minute)"
HERE = "the service compiles kernels by itself, and takes some 130 MB more until its next start: "


def used(tmp_path: Path, fault: str = "") -> subprocess.CompletedProcess[str]:
    """Two kernels, used by a process that has another one compile them."""
    (tmp_path / "two.py").write_text(KERNELS)
    (tmp_path / "lost.py").write_text("import os\ndef compile_here(**_): os._exit(1)\n")
    environment = os.environ | {"NUMBA_CACHE_DIR": f"{tmp_path}", "PYTHONPATH": f"{ROOT}:{tmp_path}"}
    return subprocess.run(
        [sys.executable, "-c", USE.format(fault=fault)],
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
        check=True,
        env=environment,
    )


def test_another_process_compiles_what_is_not_kept_and_ends(tmp_path: Path) -> None:
    first, second = used(tmp_path), used(tmp_path)
    assert first.stdout == second.stdout == "3.0 2.0\ncompiled here: 0\nnobody is left\n"
    assert first.stderr.splitlines() == [COMPILING]
    assert second.stderr == ""


FAULTS = {
    "it cannot be begun": ("sys.executable = '/nowhere/python'", r"\[Errno 2\].*'/nowhere/python'"),
    "it is lost": (
        "kernel_compiler.__name__ = 'lost'",
        r"their compiler ended with exit code 1",
    ),
    "a kernel fails in it": (
        "kernel_compiler.base64.b64encode = lambda _: b''",
        r"at_once: EOFError: .*",
    ),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_kernels_are_compiled_here_if_that_process_fails_which_is_said_once(
    fault: str, tmp_path: Path
) -> None:
    code, why = FAULTS[fault]
    done = used(tmp_path, code)
    assert done.stdout == "3.0 2.0\ncompiled here: 2\nnobody is left\n"
    compiling, here = done.stderr.splitlines()
    assert compiling == COMPILING
    assert here.startswith(HERE)
    assert re.fullmatch(why, here.removeprefix(HERE))


def test_a_kernel_that_cannot_be_written_is_of_use_all_the_same(tmp_path: Path) -> None:
    """The directory could be written when it was chosen; the disk has filled up since."""
    done = used(tmp_path, "resource.setrlimit(resource.RLIMIT_FSIZE, (0, 0))")
    assert done.stdout == "3.0 2.0\ncompiled here: 2\nnobody is left\n"
    compiling, here, not_kept = done.stderr.splitlines()
    assert compiling == COMPILING
    assert here == f"{HERE}nothing was kept in {next(tmp_path.glob('[!_]*_*'))}"
    assert not_kept.startswith(
        "compiled kernels cannot be kept, and the next start compiles them again: [Errno 27]"
    )


@contextlib.contextmanager
def starting(tmp_path: Path) -> Iterator[subprocess.Popen[str]]:
    """A service that starts; killed at the end if need be."""
    file = tmp_path / "motor.toml"
    text = MOTOR.read_text().partition("[mqtt]")[0]
    file.write_text(text.replace('interface = "socketcan"', 'interface = "virtual"'))
    process = subprocess.Popen(
        [sys.executable, "-m", "daqsvc", "run", f"{file}", "--store", f"{tmp_path / 'store'}", "-v"],
        stderr=subprocess.PIPE,
        text=True,
        env=os.environ | {"NUMBA_CACHE_DIR": f"{tmp_path / 'kernels'}"},
    )
    try:
        yield process
    finally:
        process.kill()
        process.wait()
        assert process.stderr is not None
        process.stderr.close()


def until_said(process: subprocess.Popen[str], words: str) -> str:
    """What a service says until it says this."""
    assert process.stderr is not None
    said = ""
    for line in process.stderr:
        said += line
        if words in line:
            return said
    raise AssertionError(said)


def children(pid: int) -> list[int]:
    found = ""
    for task in Path(f"/proc/{pid}/task").iterdir():
        with contextlib.suppress(FileNotFoundError, ProcessLookupError):  # a thread may end meanwhile
            found += (task / "children").read_text()
    return [int(child) for child in found.split()]


def resident_kb(pid: int) -> int:
    found = re.search(r"VmRSS:\s+(\d+) kB", Path(f"/proc/{pid}/status").read_text())
    assert found
    return int(found[1])


@pytest.mark.parametrize("how", [signal.SIGTERM, signal.SIGKILL])
def test_a_service_that_ends_while_kernels_compile_leaves_nobody_behind(
    how: signal.Signals, tmp_path: Path
) -> None:
    with starting(tmp_path) as process:
        until_said(process, "compiling kernels")
        eventually_blocking(lambda: children(process.pid), "another process compiles")
        [compiler] = children(process.pid)
        # As systemd does, which tells all processes of a service.
        os.kill(compiler, signal.SIGTERM)
        process.send_signal(how)
        assert process.wait(PATIENCE_S) == (0 if how is signal.SIGTERM else -how)
        eventually_blocking(lambda: not Path(f"/proc/{compiler}").exists(), "the compiler ends with it")


def test_the_first_start_is_content_with_the_memory_of_any_other(tmp_path: Path) -> None:
    with starting(tmp_path) as process:
        said = until_said(process, "watching motor")
        assert "compiling kernels" in said
        assert HERE not in said
        # What the start has needed is given back a moment after it; of the compiler nothing would be.
        eventually_blocking(lambda: resident_kb(process.pid) < MOST_KB, "it takes no more than it is to take")
        eventually_blocking(lambda: not children(process.pid), "the compiler has ended")
