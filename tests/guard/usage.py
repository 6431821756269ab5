"""Help texts of all verbs, and what a wrong command line is answered with: exit code and message.

Which verbs and options there are is read from the help texts, as a person would.
"""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

from guard.verbs import answer

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from guard.verbs import Answer

VALUES = ("", "nonsense", "-1", "0", "1e400", "nan", "a,b")
_BARE_WORDS = 2
"""usage: daqsvc, before the verb"""

_REFUSED = "--no-such-option"
"""Ends every command line of `wrong_values`, so that none that is right by chance is carried out."""

MISUSES = """
--version
nonsense
chekc machines/laval-rig.toml
check machines/absent.toml
check machines
check machines/laval-rig.toml machines/bearing.toml
run machines/absent.toml
run machines/specimen-other.toml
example no-such
example laval-rg
example laval-rig --out no/such/folder/m.toml
alarms machines/absent.toml
alarms machines/laval-rig.toml --store no/such
alarms --store no/such
alarms --store no/such --json
alarms --store no/such --history nonsense
ack shaft-vibration-x --store no/such
ack shaft-vibration-x machines/absent.toml
ack no-such --store no/such --json
ack x machines/laval-rig.toml --store no/such
reset shaft-vibration-x --store no/such
shelve shaft-vibration-x --store no/such
shelve shaft-vibration-x --store no/such --for nonsense
shelve shaft-vibration-x --store no/such --for 10m
unshelve shaft-vibration-x --store no/such
bypass shaft-vibration-x --store no/such
unbypass shaft-vibration-x --store no/such --json
analyze machines/laval-rig.toml
analyze machines/absent.toml run.npz
analyze run.npz
analyze run.npz machines/laval-rig.toml
analyze machines/laval-rig.toml run.npz --probes x,y
analyze machines/laval-rig.toml run.npz --channels a,b
analyze machines/laval-rig.toml run.npz --bearing 6205-2RS
analyze machines/laval-rig.toml absent.npz
analyze machines/laval-rig.toml absent.npz --json
analyze machines/laval-rig.toml absent.npz absent.csv --json --jobs 1
analyze machines/serial-probes.toml absent.npz
analyze machines/serial-probes.toml absent.npz --json
analyze machines/replay-fan.toml absent.blf --json
analyze machines/bearing.toml machines/laval-rig.toml
analyze machines/bearing.toml absent.mat --calibration absent.toml
analyze absent.npz --probes x,y --natural-frequency-hz 10 --damping-ratio 0.1
analyze absent.npz --probes x,y --speed-rpm 600
analyze absent.npz --probes x,y --speed-rpm 600 --natural-frequency-hz 10 --damping-ratio 0.1
analyze absent.npz --probes x,y --speed-rpm 600 --natural-frequency-hz 10 --damping-ratio 0.1 --json
analyze absent.npz --probes x,x --speed-rpm 600 --natural-frequency-hz 10 --damping-ratio 0.1
analyze absent.npz --probes x,y --speed-rpm 600 --natural-frequency-hz 10 --damping-ratio 0.1 --map z=x
analyze absent.npz --probes x,y --speed-rpm 600 --natural-frequency-hz 10 --damping-ratio 0.1 --unit g
analyze absent.npz --probes x,y --speed-rpm 600 --keyphasor-threshold 1 --natural-frequency-hz 1
analyze absent.npz --probes x,y --calibration absent.toml --speed-rpm 600
analyze absent.npz --probes x,y --calibration absent.toml --speed-rpm 600 --damping-ratio 0.1
analyze absent.npz --channels a
analyze absent.npz --channels a --speed-rpm 600
analyze absent.npz --channels a --speed-rpm 600 --baseline absent.npz
analyze absent.npz --channels a --speed-rpm 600 --baseline absent.npz --probes x,y
analyze absent.npz --channels a --speed-rpm 600 --baseline absent.npz --unit mm
analyze absent.npz --channels a --speed-rpm orbit:600 --baseline absent.npz
analyze absent.npz --channels a --speed-rpm 600 --baseline absent.npz --plot figures
analyze absent.npz --bearing 6205-2RS
analyze absent.npz --bearing 6205 --channels a --speed-rpm 600
analyze absent.npz --bearing 6205-2RS --channels a --speed-rpm 600
analyze absent.npz --bearing 6205-2RS --channels a --speed-rpm 600 --json
analyze absent.npz --bearing 6205-2RS --channels a,b,c --speed-rpm 600
analyze absent.npz --bearing 6205-2RS --channels a --speed-rpm orbit:600
analyze absent.npz --bearing 6205-2RS --orders BPFI=5,BPFO=3,BSF=2,FTF=0.4 --channels a --speed-rpm 600
analyze absent.npz --orders BPFI=5,BPFO=3,BSF=2 --channels a --speed-rpm 600
analyze absent.npz --balls 9 --channels a --speed-rpm 600
analyze absent.npz --balls 9 --ball-diameter-mm 8 --pitch-diameter-mm 39 --bearing 6205 --channels a
analyze absent.npz --balls 30 --ball-diameter-mm 7.94 --pitch-diameter-mm 39.04 --channels a --speed-rpm 600
analyze absent.npz --orders BPFI=3,BPFO=5,BSF=2,FTF=0.4 --channels a --speed-rpm 600
analyze absent.npz --bearing 6205-2RS --channels a --speed-rpm 600 --baseline-fs 1000
analyze absent.npz --bearing 6205-2RS --channels a --speed-rpm 600 --baseline absent.npz
analyze absent.npz --bearing 6205-2RS --channels a --speed-rpm 600 --calibration absent.toml
analyze absent.npz --bearing 6205-2RS --channels a --speed-rpm 600 --unit um
export absent.npz
export absent.npz --to run.csv
export absent.npz --to run.paquet
export absent.npz --to no/such/folder/run.csv
export absent.npz other.npz --to run.csv
export machines/laval-rig.toml --to run.csv
export machines/laval-rig.toml absent.blf --to run.csv --map a=b
export absent.mcap --to run.csv --fs 100
calibrate machines/laval-rig.toml
calibrate machines/laval-rig.toml run.npz
calibrate machines/absent.toml run.npz
calibrate machines/rotor-synchronous.toml
calibrate machines/rotor-synchronous.toml absent.npz --json
calibrate machines/rotor-synchronous.toml absent.npz
calibrate machines/rotor-synchronous.toml absent.npz --out no/such/folder/c.toml
calibrate machines/rotor-synchronous.toml absent.npz --live
calibrate machines/rotor-synchronous.toml --timeout-s 3
calibrate machines/rotor-synchronous.toml absent.npz --probes x,y
calibrate machines/bearing.toml
calibrate machines/bearing.toml absent.mat
calibrate machines/bearing.toml absent.mat other.mat
calibrate machines/bearing.toml absent.mat --json
calibrate machines/bearing.toml absent.mat --bearing 6205-2RS
calibrate absent.npz
calibrate absent.npz --live
calibrate absent.npz --probes x,y
calibrate absent.npz --probes x,y --speed-rpm 600
calibrate absent.npz --probes x,y --speed-rpm 600 --sweep-rpm 100,2000
calibrate absent.npz --probes x,y --sweep-rpm 100,2000
calibrate absent.npz --probes x,y --sweep-rpm 2000,2000
calibrate absent.npz --probes x,y --speed-rpm 600 --predict-rpm 100
calibrate absent.npz --channels a --speed-rpm 600
calibrate absent.npz --channels a --speed-rpm 600 --bearing 6205-2RS
calibrate absent.npz --channels a --speed-rpm 600 --bearing 62
detectability machines/absent.toml
detectability machines/bearing.toml
detectability machines/serial-probes.toml
detectability machines/rotor-synchronous.toml
detectability machines/rotor-synchronous.toml --process-noise 1
detectability machines/laval-rig.toml --eccentricity-um 5
record machines/laval-rig.toml
record machines/absent.toml --out log.blf
record machines/laval-rig.toml --out log.txt
record machines/laval-rig.toml --out no/such/folder/log.blf
record machines/laval-rig.toml --out log.blf --bus no-such
record machines/serial-probes.toml --out log.blf
record machines/rotor-two-buses.toml --out log.blf
sniff nonsense
sniff can
sniff can no-such-interface --seconds 0
sniff can no-such-interface --bitrate 5
sniff can no-such-interface --dbc absent.dbc
sniff can no-such-interface --interface no-such
sniff modbus
sniff modbus 127.0.0.1 --units 0-300
sniff modbus 127.0.0.1 --registers 9-3
sniff modbus no/such:port
sniff serial
sniff serial no/such/port
sniff serial no/such/port --baud 0
sniff serial no/such/port --seconds 0
demo --scenario no-such
demo --scenario machines/laval-rig.toml
demo --recording absent.npz
demo --recording absent.npz --scenario paper
demo --recording absent.npz --seed 1
demo --map a=b
demo --baseline absent.npz
demo --recording absent.npz --baseline-fs 1
demo --recording absent.npz --bearing 6205-2RS
demo --recording absent.npz --bearing 6205-2RS --speed-rpm 600 --unit um
demo --broker mqtts://broker.example
demo --broker mqtt://user:secret@broker.example
demo --broker mqtt://broker.example/path
demo --speed 0
sim
sim machines/absent.toml
sim machines/laval-rig.toml --scenario no-such
sim machines/laval-rig.toml --scenario paper --recording absent.npz
sim machines/serial-probes.toml --scenario paper --stream no-such
sim no-such-scenario
reproduce
reproduce --out machines/laval-rig.toml/folder
""".strip().splitlines()
"""Command lines whose mistakes no single option shows; none of them may start anything."""


def helps() -> Iterator[Answer]:
    """The help of the whole, of every verb, and of the verbs below one."""
    yield (whole := answer("--help"))
    for verb in verbs(whole.out):
        yield (told := answer(verb, "--help"))
        for below in verbs(told.out):
            yield answer(verb, below, "--help")


def verbs(help_text: str) -> list[str]:
    """The verbs that the help of the whole lists."""
    _, _, listed = help_text.partition("\nverbs:\n")
    return re.findall(r"^    (\w+)(?: |$)", listed, re.MULTILINE)


def wrong_lines() -> Iterator[Answer]:
    """Every verb with too little, with too much, and with an unknown option; `MISUSES`."""
    yield answer()
    for told in list(helps())[1:]:
        verb = told.arguments[:-1]
        if _needs_something(told.out, verb):
            yield answer(*verb)
        yield answer(*verb, _REFUSED)
        yield answer(*verb, *["file"] * 9, _REFUSED)
    for line in MISUSES:
        yield answer(*line.split())


def wrong_values() -> Iterator[str]:
    """What each option of each verb says of values, a line each."""
    for told in list(helps())[1:]:
        words = told.arguments[:-1]
        verb = " ".join(words)
        files = ["file"] * _needs_something(told.out, words)
        for option, takes_value in _options(told.out):
            for value in VALUES if takes_value else ("nonsense",):
                given = answer(*words, *files, f"{option}={value}", _REFUSED)
                said = given.err.strip().removeprefix(f"daqsvc {verb}: ")
                if f"unrecognized arguments: {_REFUSED}" in said:
                    said = "accepted"
                yield f"{verb} {option}={value}: {said} (exit code {given.code})"
            if takes_value:
                yield f"{verb} {option}: {answer(*words, *files, option).err.strip()}"


def _needs_something(help_text: str, verb: Sequence[str]) -> bool:
    """Whether the usage line of a verb has anything but what may be left out."""
    usage = " ".join(help_text.partition("\n\n")[0].split())
    while (shorter := re.sub(r"\[[^\[\]]*\]", "", usage)) != usage:
        usage = shorter
    return len(usage.split()) > _BARE_WORDS + len(verb)


def _options(help_text: str) -> list[tuple[str, bool]]:
    """Names of the options in the help of a verb, and whether they take a value."""
    found = re.findall(r"^  (?:-\w(?: \w+)?, )?(--[a-z0-9-]+)( \S)?", help_text, re.MULTILINE)
    return [(name, bool(value)) for name, value in found if name != "--help"]
