"""A benchmark that misses what is asked of it fails."""

from __future__ import annotations

import runpy
import socket
import threading

import pytest
from support.paths import ROOT

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
