"""A benchmark that misses what is asked of it fails."""

from __future__ import annotations

import runpy
import socket
import threading
from typing import TYPE_CHECKING

import numpy as np
import pytest
from support.paths import ROOT

from drivers.can.plugin import frame_layout

if TYPE_CHECKING:
    from pathlib import Path

BENCH = ROOT / "tests" / "bench"


def test_one_missed_target_of_several_fails(capsys: pytest.CaptureFixture[str]) -> None:
    targets = runpy.run_path(str(BENCH / "targets.py"))["Targets"]()
    targets.ask("at least 10", "11", 1.1)
    assert targets.exit_code == 0
    targets.ask("at most 50 ms", "60 ms", 50.0 / 60.0)
    targets.ask("at least 1", "1", 1.0)
    assert targets.exit_code == 1
    assert targets.missed == ["at most 50 ms"]
    told = capsys.readouterr().out.splitlines()
    assert [line.rpartition(" ")[2] for line in told] == ["met", "MISSED", "met"]


def test_every_benchmark_that_asks_for_something_ends_with_what_came_of_it() -> None:
    asking = {path.name: path.read_text() for path in BENCH.glob("bench_*.py") if ".ask(" in path.read_text()}
    assert {"bench_bearing.py", "bench_race.py", "bench_rotor.py", "bench_can.py"} <= asking.keys()
    for name, text in asking.items():
        assert "sys.exit(main())" in text, name
        assert "targets.exit_code" in text, name


@pytest.mark.parametrize(("takes", "least", "most"), [(True, 2000, 2000), (False, 1, 1000)])
def test_a_load_counts_only_what_the_other_end_has_taken(
    monkeypatch: pytest.MonkeyPatch,
    takes: bool,  # noqa: FBT001  pytest names it
    least: int,
    most: int,
) -> None:
    monkeypatch.syspath_prepend(str(BENCH))
    bench = runpy.run_path(str(BENCH / "bench_hostile_counters.py"))
    send = bench["send"]
    monkeypatch.setitem(send.__globals__, "LOAD_S", 0.2)
    monkeypatch.setitem(send.__globals__, "PATIENCE_S", 20.0 if takes else 0.1)
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)

    def read_all() -> None:
        while theirs.recv(100):
            pass

    reader = threading.Thread(target=read_all)
    if takes:
        reader.start()
    with theirs:
        with ours:
            sent, took_s = send(bench["Load"]("can", "sound", 10_000), ours.fileno())
        if takes:
            reader.join(10)
    assert least <= sent <= most
    assert took_s >= 0.2


def test_what_watching_costs_is_measured_on_devices_that_go_on(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """They are sent over and over: a counter that leaps would cost what a device that restarts does."""
    monkeypatch.syspath_prepend(str(BENCH))
    bench = runpy.run_path(str(BENCH / "bench_cost.py"))
    layout = frame_layout(bench["rig"](tmp_path), "shaft")
    frames = bench["can_frames"]()
    payloads = np.frombuffer(b"".join(frames), np.uint8).reshape(len(frames), -1)[:, 8 : 8 + layout.length]
    found = layout.decode(payloads, np.zeros(len(frames), np.int64))
    assert found.intact.all()
    assert set((np.roll(found.counter, -1) - found.counter) % 2**16) == {layout.samples_per_frame}
    counts = np.array([int(line.split(b",")[0]) for line in bench["line_bytes"]()])
    assert set((np.roll(counts, -1) - counts) % 2**16) == {1}
