"""What a machine file can say of a SocketCAN bus, and what it cannot."""

from __future__ import annotations

from support.machine_files import LAVAL, only_problem, parsed


def test_buffer_and_filter_are_settings_of_the_bus() -> None:
    bus = (
        parsed(LAVAL, ("fd = true", "fd = true\nreceive_buffer_bytes = 1_000_000\nfilter = false"))
        .buses["can0"]
        .model_dump()
    )
    assert (bus["receive_buffer_bytes"], bus["filter"]) == (1_000_000, False)


def test_options_of_python_can_are_refused() -> None:
    problem, line = only_problem(LAVAL, ("fd = true", "fd = true\noptions = { local_loopback = false }"))
    assert problem.line == line + 1
    assert "mean nothing to SocketCAN" in str(problem)
    assert "remove local_loopback" in str(problem)
