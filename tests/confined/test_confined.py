"""Work in a process of its own: its limits hold, its loss is an error, and the next call goes on."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path
from threading import Thread

import numpy as np
import pytest

from daqsvc.confined.limits import FREE_BYTES, Budget, ResourceLimits, TooLargeError
from daqsvc.confined.process import ConfinedError, ConfinedProcess, RaisedThereError

MEMORY = 300_000_000


@pytest.fixture
def process():
    with ConfinedProcess() as process:
        yield process


def call(process, name, memory_bytes=MEMORY, cpu_s=30.0, **arguments):
    return process.call(f"support.confined_work:{name}", arguments, memory_bytes=memory_bytes, cpu_s=cpu_s)


def test_numbers_come_back_from_one_process_for_many_calls(process):
    first = call(process, "double", numbers=[1.0, np.inf])
    assert [array.tolist() for array in first.arrays] == [[2.0, np.inf], []]
    assert first.arrays[1].shape == (0, 3)
    assert call(process, "double", numbers=[1.0]).document == first.document != {"pid": os.getpid()}


def test_names_of_files_begin_where_the_caller_is_now(process, tmp_path, monkeypatch):
    first = call(process, "whereabouts").document
    assert first["directory"] == f"{Path.cwd()}"
    monkeypatch.chdir(tmp_path)
    now = call(process, "whereabouts").document
    assert now == {"directory": f"{tmp_path}", "pid": first["pid"]}
    # From a directory that is gone whole paths still lead to files.
    gone = tmp_path / "gone"
    gone.mkdir()
    monkeypatch.chdir(gone)
    gone.rmdir()
    assert call(process, "whereabouts").document == now


def test_an_error_there_is_an_error_here(process):
    with pytest.raises(RaisedThereError, match="KeyError: 'no such thing'"):
        call(process, "fail")
    with pytest.raises(RaisedThereError, match="AttributeError"):
        call(process, "nothing_of_this_name")


def test_what_libraries_print_is_no_answer(process):
    assert call(process, "chatter").document == "said"


@pytest.mark.parametrize(
    ("name", "arguments", "reason", "how"),
    [
        ("crash", {}, "crash", "SIGSEGV"),
        ("leave", {}, "crash", "exit code 7"),
        ("take_memory", {"count": MEMORY // 6}, "memory", "more memory than it may"),
    ],
)
def test_a_loss_costs_one_call(process, name, arguments, reason, how):
    before = call(process, "double", numbers=[1.0]).document
    with pytest.raises(ConfinedError, match=how) as lost:
        call(process, name, **arguments)
    assert lost.value.reason == reason
    assert call(process, "double", numbers=[1.0]).document != before
    assert call(process, "take_memory", count=MEMORY // 16).document == MEMORY // 16


def test_processor_time_is_bounded(process):
    with pytest.raises(ConfinedError, match="more processor time than it may") as lost:
        call(process, "spin", cpu_s=0.2)
    assert lost.value.reason == "time"


def test_processor_time_is_counted_for_each_call(process):
    for _ in range(3):
        call(process, "take_memory", count=1000, cpu_s=0.0)


def test_more_arrays_than_memory_are_not_taken_over(process, monkeypatch):
    with pytest.raises(ConfinedError, match="more memory"):
        call(process, "grow", memory_bytes=50_000_000, rows=20_000_000)


def test_an_interrupted_call_leaves_nothing_to_be_mistaken_for_an_answer(process, monkeypatch):
    def interrupt(*_):
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr(os, "readv", interrupt)
        with pytest.raises(KeyboardInterrupt):
            call(process, "double", numbers=[1.0])
    assert call(process, "double", numbers=[3.0]).arrays[0].tolist() == [6.0]


def test_a_call_of_another_thread_can_be_aborted(process):
    outcome = []

    def work():
        try:
            call(process, "spin")
        except ConfinedError as error:
            outcome.append(error)

    thread = Thread(target=work)
    thread.start()
    while process._running is None:
        time.sleep(0.01)
    process.abort()
    thread.join(60)
    assert not thread.is_alive()
    assert len(outcome) == 1
    with pytest.raises(ConfinedError, match="was stopped"):
        call(process, "double", numbers=[1.0])
    process.close()
    assert call(process, "double", numbers=[3.0]).arrays[0].tolist() == [6.0]


def test_it_ends_with_whoever_began_it():
    script = (
        "from daqsvc.confined.process import shared\n"
        "call = {'memory_bytes': 10**9, 'cpu_s': 9.0}\n"
        "print(shared.call('support.confined_work:double', {'numbers': [1]}, **call).document['pid'])\n"
        "import os, sys; sys.stdout.flush(); os._exit(0)\n"
    )
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    run = subprocess.run(
        [sys.executable, "-c", script], env=environment, capture_output=True, text=True, check=True
    )
    until = time.monotonic() + 20
    while Path(f"/proc/{int(run.stdout)}").exists():
        assert time.monotonic() < until
        time.sleep(0.02)


def test_nothing_of_the_working_directory_is_run(tmp_path, monkeypatch):
    (tmp_path / "json.py").write_text("raise SystemExit(3)")
    monkeypatch.chdir(tmp_path)
    with ConfinedProcess() as process:
        assert call(process, "double", numbers=[1.0]).arrays[0].tolist() == [2.0]


def test_a_budget_is_bounded_by_the_file_and_by_memory():
    small = Budget(1_000, ResourceLimits(10**12).content_bytes)
    small.check_declared(FREE_BYTES)
    with pytest.raises(TooLargeError, match="its 1 kB claims to unpack to 64 MB, 200 times and more"):
        small.check_declared(FREE_BYTES + 1)
    small.spend(FREE_BYTES)
    with pytest.raises(TooLargeError, match="its 1 kB unpacks to more than 64 MB"):
        small.spend(1)
    large = Budget(10**9, ResourceLimits(10**9).content_bytes)
    with pytest.raises(TooLargeError, match=r"500 MB may be read; allow more memory \(--max-memory"):
        large.check_declared(0.6e9)
