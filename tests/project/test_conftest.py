"""The guards of conftest.py really fail a test that leaves something behind."""

import os
import subprocess
import sys
from pathlib import Path

from support.paths import ROOT

LEAKY = """
import asyncio, gc, threading

class Cycle:
    def __init__(self, held):
        self.itself, self.held = self, held

Cycle(open("left-at-import", "w"))

def test_file_of_the_module():
    pass

def test_file():
    Cycle(open("left-by-a-test", "w"))
    gc.collect()

async def test_task():
    test_task.kept = asyncio.create_task(asyncio.sleep(30), name="left-behind")

def test_thread():
    threading.Thread(target=threading.Event().wait, args=(5,), name="still-there", daemon=True).start()

async def test_clean():
    await asyncio.gather(asyncio.sleep(0), asyncio.to_thread(int))
"""


def test_leaks_fail_the_test_that_leaves_them(tmp_path: Path) -> None:
    here = ROOT / "tests"
    guards = (here / "conftest.py").read_text()
    assert "GRACE_S = 30.0" in guards
    (tmp_path / "conftest.py").write_text(guards.replace("GRACE_S = 30.0", "GRACE_S = 1.0"))
    (tmp_path / "test_leaky.py").write_text(LEAKY)
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "--rootdir", str(tmp_path)]
    command += ["-c", str(ROOT / "pyproject.toml"), str(tmp_path)]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(here), *sys.path])}
    done = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path, env=environment, check=False)
    assert "tasks that outlive the test: ['left-behind']" in done.stdout
    assert "threads that outlive the test: ['still-there']" in done.stdout
    assert "unclosed file <_io.FileIO name='left-at-import'" in done.stdout
    assert "unclosed file <_io.FileIO name='left-by-a-test'" in done.stdout
    assert "1 failed, 3 passed, 3 errors" in done.stdout  # most bodies pass, what is around them does not
