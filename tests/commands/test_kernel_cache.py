"""Accounts that may write nowhere, or only in the folder for temporary files: every verb works there."""

from __future__ import annotations

import os
import resource
import shutil
import stat
import subprocess
import sys
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from support.paths import ROOT

from daqsvc import kernel_cache

if TYPE_CHECKING:
    from pathlib import Path

pytestmark = pytest.mark.integration
NOBODY = 65_534
AS_NOBODY = [
    "setpriv",
    f"--reuid={NOBODY}",
    f"--regid={NOBODY}",
    "--clear-groups",
    # The interpreter may be below a home that others may not look into.
    "--inh-caps=+dac_read_search",
    "--ambient-caps=+dac_read_search",
]
FILES = ROOT / "config" / "machines"
BEARING = (
    "there-is-one.npz",
    "--channels",
    "acc",
    "--speed-rpm",
    "1797",
    "--bearing",
    "6205-2RS",
    "--fs",
    "12000",
)
USING_KERNELS = {
    "check": ["check", FILES / "rotor-synchronous.toml"],
    "record": ["record", FILES / "virtual-rig.toml", "--out", "x.log", "--duration", "0.2"],
    "analyze": ["analyze", FILES / "rotor-synchronous.toml", "there-is-none.npz"],
    "analyze a bearing": ["analyze", *BEARING],
    "calibrate a bearing": ["calibrate", *BEARING, "--out", "b.toml"],
    "calibrate": ["calibrate", FILES / "rotor-synchronous.toml", "there-is-none.npz"],
    "alarms": ["alarms", FILES / "laval-rig.toml"],
}
needs_root = pytest.mark.skipif(os.geteuid() != 0, reason="only root can become somebody else")
needs_setpriv = pytest.mark.skipif(shutil.which("setpriv") is None, reason="no setpriv on this machine")


def daqsvc(
    *arguments: object, before: tuple[str, ...] = (), **options: Any
) -> subprocess.CompletedProcess[str]:
    environment = {
        k: v for k, v in os.environ.items() if k not in {"NUMBA_CACHE_DIR", "HOME", "XDG_CACHE_HOME"}
    }
    environment |= {"PYTHONPATH": str(ROOT), "HOME": "/nonexistent"} | options.pop("env", {})
    command = [*before, sys.executable, "-m", "daqsvc", *map(str, arguments)]
    return subprocess.run(
        command, capture_output=True, text=True, timeout=100, check=False, env=environment, **options
    )


@needs_root
@needs_setpriv
@pytest.mark.parametrize(
    "verb",
    [pytest.param(v, marks=[] if v == "check" else pytest.mark.long) for v in USING_KERNELS],
)
def test_an_account_without_a_home_can_use_every_verb(verb: str, tmp_path: Path) -> None:
    tmp_path.chmod(0o755)
    temporary = tmp_path / "tmp"
    temporary.mkdir()
    temporary.chmod(0o1777)
    np.savez(temporary / "there-is-one.npz", acc=np.random.default_rng(1).standard_normal(60_000))
    done = daqsvc(
        *USING_KERNELS[verb], before=tuple(AS_NOBODY), env={"TMPDIR": str(temporary)}, cwd=temporary
    )
    assert "Traceback" not in done.stderr
    assert "no locator" not in done.stderr
    if "bearing" in verb:
        assert done.returncode == 0, done.stderr
    if verb.startswith("check"):
        assert done.returncode == 0
        (said,) = [line for line in done.stderr.splitlines() if "kernels" in line]
        assert said.startswith(f"compiled kernels are kept in {temporary}/daqsvc-kernels-{NOBODY}, where")
        assert said.endswith("set NUMBA_CACHE_DIR to a directory that the service can write")
        kept = temporary / f"daqsvc-kernels-{NOBODY}"
        assert (stat.S_IMODE(kept.stat().st_mode), kept.stat().st_uid) == (0o700, NOBODY)


@pytest.mark.long
def test_where_nothing_can_be_written_kernels_are_compiled_and_not_kept(tmp_path: Path) -> None:
    """Every kernel there is can be imported, and one is used."""
    use = (
        "from daqsvc import kernel_cache; kernel_cache.prepare()\n"
        "import daqsvc.rotor.sweep, daqsvc.bearing.residual, drivers.serial.line_kernels\n"
        "import daqsvc.bearing.sliding_mode, sim_hw.reproduce.bearing.experiment\n"
        "import numpy as np\n"
        "from drivers.serial.kernels import gather\n"
        "print(gather(np.arange(9, dtype=np.uint8), np.array([1, 4]), 2).tolist())\n"
    )
    environment = {k: v for k, v in os.environ.items() if k != "NUMBA_CACHE_DIR"}
    done = subprocess.run(
        [sys.executable, "-c", use],
        capture_output=True,
        text=True,
        timeout=100,
        check=False,
        env=environment | {"PYTHONPATH": str(ROOT), "HOME": str(tmp_path)},
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (0, 0)),
    )
    assert done.stdout == "[[1, 2], [4, 5]]\n", done.stderr
    said, *_ = done.stderr.splitlines()
    assert said.startswith("compiled kernels cannot be kept, and every start compiles them: ")


@pytest.mark.long
def test_that_kernels_are_compiled_is_said_once_and_only_if_none_are_kept(tmp_path: Path) -> None:
    kernels = "from daqsvc.kernels import njit\n" + "".join(
        f"@njit(cache=True)\ndef {name}(x):\n    return x + 1\n" for name in ("f", "g")
    )
    (tmp_path / "two.py").write_text(kernels)
    use = (
        "import logging, sys; from daqsvc import kernel_cache\n"
        "logging.basicConfig(format='%(message)s', level='NOTICE')\n"
        "kernel_cache.prepare()\n"
        "import two; two.f(1.0), two.g(1.0)\n"
    )
    environment = os.environ | {"NUMBA_CACHE_DIR": f"{tmp_path}", "PYTHONPATH": f"{ROOT}:{tmp_path}"}
    command = [sys.executable, "-c", use]
    said = [
        subprocess.run(
            command, stderr=subprocess.PIPE, text=True, timeout=100, check=True, env=environment
        ).stderr
        for _ in range(2)
    ]
    assert said == ["compiling kernels for this processor (first start only; takes up to a minute)\n", ""]


@pytest.fixture
def places(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A world with a home and a folder for temporary files."""
    for name in ("NUMBA_CACHE_DIR", "CACHE_DIRECTORY", "XDG_CACHE_HOME"):
        monkeypatch.delenv(name, raising=False)
    (tmp_path / "tmp").mkdir(mode=0o1777)
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "tmp"))
    monkeypatch.setenv("NUMBA_CACHE_DIR", "to be taken back")
    monkeypatch.delenv("NUMBA_CACHE_DIR")
    return tmp_path


def chosen() -> str:
    kernel_cache.prepare()
    return os.environ.pop("NUMBA_CACHE_DIR")


def test_the_place_is_the_one_that_was_asked_for(
    places: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    assert chosen() == f"{places}/home/.cache/daqsvc/kernels"
    monkeypatch.setenv("XDG_CACHE_HOME", f"{places}/xdg")
    assert chosen() == f"{places}/xdg/daqsvc/kernels"
    monkeypatch.setenv("CACHE_DIRECTORY", f"{places}/one:{places}/two")
    assert chosen() == f"{places}/one/kernels"
    monkeypatch.setenv("NUMBA_CACHE_DIR", f"{places}/mine")
    assert chosen() == f"{places}/mine"
    assert not caplog.records


@needs_root
def test_the_account_of_the_service_finds_what_the_service_has_compiled(
    places: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    service = places / "var-cache-daqsvc"
    monkeypatch.setattr(kernel_cache, "SERVICE", service)
    assert chosen() == f"{places}/home/.cache/daqsvc/kernels"
    service.mkdir()
    assert chosen() == f"{service}/kernels"
    os.chown(service, NOBODY, NOBODY)
    assert chosen() == f"{places}/home/.cache/daqsvc/kernels", "what another account has compiled is not run"


@pytest.mark.gives("S14")
def test_a_place_that_others_can_write_is_not_trusted(places: Path, caplog: pytest.LogCaptureFixture) -> None:
    (places / "home").mkdir()
    (places / "home").chmod(0o777)
    assert chosen() == str(places / "tmp" / f"daqsvc-kernels-{os.geteuid()}")
    (said,) = caplog.messages
    assert f"can be replaced by others, who can write {places}/home" in said


@needs_root
def test_a_place_that_somebody_else_has_laid_out_is_not_taken(
    places: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    forged = places / "tmp" / f"daqsvc-kernels-{os.geteuid()}"
    forged.mkdir()
    os.chown(forged, NOBODY, NOBODY)
    monkeypatch.setenv("CACHE_DIRECTORY", "/proc/nowhere")
    without: list[bool] = []
    monkeypatch.setattr(kernel_cache, "_compile_at_every_start", lambda: without.append(True))
    kernel_cache.prepare()
    assert without == [True]
    assert "NUMBA_CACHE_DIR" not in os.environ
    assert f"{forged} can be written by others" in caplog.text
