"""What ``daqsvc sim`` can be asked for, and what it says to what it cannot do."""

from __future__ import annotations

import re
from dataclasses import asdict

import pytest
from machine_files import MOTOR
from sim_processes import DOCUMENTATION, PATIENCE_S, PER_FRAME, SCENARIOS, VIRTUAL_RIG, process

from sim_hw.scenario import load_any_scenario


def test_every_scenario_that_comes_along_can_be_read_and_says_what_goes_wrong() -> None:
    every = {path.stem: load_any_scenario(path) for path in SCENARIOS.glob("*.toml")}
    assert set(every) == {"bad-bus", "bearing-damage"}
    faults = every["bad-bus"].node_faults()
    assert faults is not None
    counts = faults.plan(19_200, 640.0, samples_per_frame=PER_FRAME, length=64).injected()
    nothing = [name for name, count in asdict(counts).items() if not count]
    assert not nothing
    # The documentation has each of them.
    table = DOCUMENTATION.read_text().split("| `kind` |")[1]
    named = re.findall(r"^\| `([a-z-]+)` \|", table, flags=re.MULTILINE)
    assert sorted(named) == sorted({fault.kind for fault in every["bad-bus"].fault})


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((), "name a machine file or a scenario to play, or a bus to run"),
        (("paper", "--fs", "100"), "--fs goes with a recording"),
        (("paper", "--port", "70000"), "70000 is not a TCP port"),
        (
            ("nothing",),
            "there is no scenario 'nothing': neither a file nor one of healthy",
        ),
        ((VIRTUAL_RIG, "--stream", "wave"), "has no stream 'wave'; there are shaft"),
        ((SCENARIOS / "bearing-damage.toml",), "a bearing needs sensors"),
        (
            (VIRTUAL_RIG, "--scenario", SCENARIOS / "bearing-damage.toml"),
            "sensor 'probe-x' is of type 'proximity', and a bearing scenario gives accelerometers",
        ),
        (
            (MOTOR,),
            "sensor 'accel-de' is of type 'accelerometer', and a rotor scenario gives proximity probes",
        ),
        ((VIRTUAL_RIG, "--bus", "/nowhere/can0", "--duration", "1"), "no bus can be made at /nowhere/can0"),
    ],
)
def test_what_cannot_be_played_says_why(arguments: tuple[object, ...], message: str) -> None:
    with process("sim", *arguments) as sim:
        output, errors = sim.communicate(timeout=PATIENCE_S)
    assert sim.returncode in {1, 2}
    assert message in errors
    assert "Traceback" not in errors
    assert output == ""
