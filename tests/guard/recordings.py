"""What `analyze --json` and `calibrate --json` say of every recording in $DAQSVC_DATA.

Of each recording the golden file has the verdict and the SHA-256 of the whole JSON line, every digit of it;
the lines themselves are kept in .cache/guard/ (`taken` with --take, `now` with every run), so that a
difference can be shown key by key. Left out of them is one field: when a calibration was written.

Recordings are read where they lie, by a link, under names that are the same everywhere.
"""

from __future__ import annotations

import csv
import hashlib
import json
import os
import re
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from guard.verbs import ROOT, answer, workplace

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping

DATA = Path(os.environ.get("DAQSVC_DATA", ROOT / ".." / "shared" / "data")).resolve()
RECORDED = Path(__file__).parent / "recorded"
CACHE = ROOT / ".cache" / "guard"
TAKEN_ON = RECORDED / "processor"
"""The kind of processor that the golden digests of all recordings were taken on; see `processor`."""
NO_RECORDINGS = frozenset({".md", ".txt", ".dbc", ".png", ".yaml", ".json", ".fuck", ".pcap", ".log", ""})
"""Endings of files that are not meant for `analyze`: packet captures, logs of Zeek, descriptions."""
_CODE = re.compile(r', "code": (?:null|"[A-Z][0-9]{2}")| \[[A-Z][0-9]{2}\]$', re.MULTILINE)
"""The code of an error, which tests/errors holds: the digest is of all else."""
_WRITTEN = re.compile(r'("written": ")[^"]*')
_MOST_CHARACTERS = 120
TABLES_OF_RESULTS = frozenset({"smith_randall_2015.csv", "cwru_meta"})

ADI_ORDERS = "BPFI=4.95,BPFO=3.05,BSF=1.992,FTF=0.3817"
MFPT_ORDERS = "BPFI=4.755,BPFO=3.245,BSF=2.175,FTF=0.4056"
ROSS_ROTOR = (
    *("--probes", "x_disc,y_disc", "--unit", "m", "--natural-frequency-hz", "85", "--damping-ratio", "0.17"),
    *("--clearance-um", "342"),
)


@dataclass(frozen=True)
class Call:
    """One call of a verb.

    Attributes:
        title: what is asked.
        recordings: paths relative to the data, or of the workplace.
        options: all other arguments.
        verb: which one.
        machine: machine file before the recordings.
    """

    title: str
    recordings: tuple[str, ...]
    options: tuple[str, ...] = ()
    verb: str = "analyze"
    machine: str | None = None

    @property
    def arguments(self) -> list[str]:
        """Of the command line."""
        first = [] if self.machine is None else [f"machines/{self.machine}"]
        jobs = ["--jobs", "1"] if self.verb == "analyze" else []
        return [self.verb, *first, *self.recordings, *self.options, *jobs, "--json"]


def processor() -> str:
    """What the last digits of a digest depend on: whether there is AVX-512."""
    return "avx512f" if " avx512f" in Path("/proc/cpuinfo").read_text(encoding="utf-8") else "no avx512f"


def _cwru() -> Iterator[Call]:
    with (DATA / "smith_randall_2015.csv").open(encoding="utf-8") as table:
        speeds = {row["record"]: row["nominal_rpm"] for row in csv.DictReader(table)}
    names = sorted((path.stem for path in (DATA / "cwru").glob("*.mat")), key=int)
    healthy = (
        "--baseline",
        "data/cwru/97.mat",
        "--baseline-map",
        "DE_time=X097_DE_time",
        "--baseline-fs",
        "48000",
    )
    for name in names:
        file = (f"data/cwru/{name}.mat",)
        speed = ("--fs", "12000" if name in speeds else "48000", "--speed-rpm", speeds.get(name, "1797"))
        own = ("--map", f"DE_time=X{int(name):03d}_DE_time")
        bearing = ("--channels", "DE_time", *own, *speed, "--bearing", "6205-2RS")
        yield Call("bearing", file, bearing)
        yield Call("bearing against healthy", file, (*bearing, *healthy))
        yield Call("fan end", file, ("--channels", "FE_time", *speed, "--bearing", "6203-2RS"))
        yield Call(
            "machine file",
            file,
            ("--map", f"accel-de=X{int(name):03d}_DE_time", "--fs", speed[1]),
            machine="cwru.toml",
        )
    steady = (
        "--channels",
        "DE_time",
        "--map",
        "DE_time=X097_DE_time",
        "--fs",
        "48000",
        "--speed-rpm",
        "1797",
    )
    yield Call("calibrate", ("data/cwru/97.mat",), (*steady, "--bearing", "6205-2RS"), verb="calibrate")


def _mfpt() -> Iterator[Call]:
    names = sorted(path.stem for path in (DATA / "mfpt" / "train").glob("*.mat"))
    bearing = ("--channels", "a", "--map", "a=bearing.gs", "--speed-rpm", "1500", "--orders", MFPT_ORDERS)
    for name in names:
        file = (f"data/mfpt/train/{name}.mat",)
        rate = ("--fs", "48828" if "vload" in name else "97656")
        yield Call("bearing", file, (*bearing, *rate))
        healthy = ("--baseline", "data/mfpt/train/baseline_1.mat", "--baseline-fs", "97656")
        yield Call("bearing against healthy", file, (*bearing, *rate, *healthy))
    yield Call(
        "calibrate", ("data/mfpt/train/baseline_1.mat",), (*bearing, "--fs", "97656"), verb="calibrate"
    )


def _adi() -> Iterator[Call]:
    folder = "adi_cbm/Data_ADXL356C"
    names = sorted(path.name for path in (DATA / folder).glob("*.gz"))
    for name in names:
        file, rpm = (f"data/{folder}/{name}",), name[:4]
        healthy = ("--baseline", f"data/{folder}/{rpm}_GoB_GS_BaLo_WA_00lb.Wfm.csv.gz")
        axes = (
            "--channels",
            "X,Y,Z",
            "--map",
            "X=1,Y=2,Z=3",
            "--fs",
            "20000",
            "--unit",
            "V",
            "--speed-rpm",
            rpm,
        )
        radial = ("--channels", "Y", "--map", "Y=2", "--fs", "20000", "--unit", "V", "--speed-rpm", rpm)
        yield Call("orders against balanced", file, (*axes, *healthy))
        yield Call("bearing", file, (*radial, "--orders", ADI_ORDERS))
        yield Call("bearing against balanced", file, (*radial, "--orders", ADI_ORDERS, *healthy))
    balanced = (f"data/{folder}/1800_GoB_GS_BaLo_WA_00lb.Wfm.csv.gz",)
    learnt = (
        "--channels",
        "Y",
        "--map",
        "Y=2",
        "--fs",
        "20000",
        "--speed-rpm",
        "1800",
        "--orders",
        ADI_ORDERS,
    )
    yield Call("calibrate", balanced, learnt, verb="calibrate")


def _ross() -> Iterator[Call]:
    for path in sorted(
        (DATA / "ross").glob("*.npz"), key=lambda path: ("healthy" not in path.name, path.name)
    ):
        with np.load(path) as held:
            rpm = repr(float(held["omega"]) * 30.0 / np.pi) if "omega" in held else "3000"
            _add_noise(held, Path(f"noisy-{path.name}"))
        clean, noisy = (f"data/ross/{path.name}",), (f"noisy-{path.name}",)
        for file, what in ((clean, "without noise"), (noisy, "at 20 dB")):
            yield Call(f"rotor {what}", file, (*ROSS_ROTOR, "--speed-rpm", rpm))
            learnt = (
                *ROSS_ROTOR,
                "--speed-rpm",
                rpm,
                "--revolutions",
                "100",
                "--out",
                f"{what}-{path.stem}.toml",
            )
            yield Call(f"calibrate {what}", file, learnt, verb="calibrate")
        if path.name.startswith("A1_"):
            probes = ("--probes", "x_disc,y_disc", "--unit", "m", "--speed-rpm", rpm, "--clearance-um", "342")
            known = ("--calibration", "at 20 dB-A1_healthy_e0p1.toml")
            yield Call("rotor by its calibration", noisy, (*probes, *known))
        yield Call("rotor by its keyphasor", noisy, (*ROSS_ROTOR, "--keyphasor", "k"))
        yield Call("rotor by its orbit", noisy, (*ROSS_ROTOR, "--speed-rpm", f"orbit:{rpm}"))
        names = ("--map", "probe-x=x_disc,probe-y=y_disc,keyphasor=k", "--unit", "m")
        yield Call("machine file", noisy, names, machine="ross.toml")
    run_up = ("--sweep-rpm", "1022.2,8177.5")
    yield Call("run-up", ("data/ross/A_runup_healthy_e0p1.npz",), (*ROSS_ROTOR, *run_up), verb="calibrate")


def _add_noise(held: Mapping[str, Any], path: Path) -> None:
    """The probes with white noise, 20 dB below the healthy part, and a keyphasor, as a recording."""
    rng = np.random.default_rng(1)
    length = len(held["x_disc"])
    onset = int(held["onset"][0]) if "onset" in held and len(held["onset"]) else length
    probes = {
        name: held[name] + 0.1 * held[name][:onset].std() * rng.standard_normal(length)
        for name in ("x_disc", "y_disc")
    }
    t_s = np.arange(length) / float(held["fs"])
    if "omega" in held:
        angle = float(held["theta0"]) + float(held["omega"]) * t_s
    else:
        angle = float(held["w0"]) * t_s + 0.5 * float(held["w1"] - held["w0"]) / float(held["T"]) * t_s**2
    pulse = np.where(angle % (2.0 * np.pi) < 0.4, -2.0, -10.0)
    np.savez(path, fs=held["fs"], k=pulse, **probes)


def _logs() -> Iterator[Call]:
    yield Call("machine file", ("data/can/motec_candump/can_sample.log.gz",), machine="formula-student.toml")
    yield Call(
        "machine file", ("data/can/derived/css_94C49784_imu100hz_static.log.gz",), machine="gnss-imu.toml"
    )
    yield Call("wrong machine file", ("data/can/motec_candump/can_sample.log.gz",), machine="gnss-imu.toml")


def _others() -> Iterator[Call]:
    """Tables that are no waveforms, and formats that `analyze` does not read: what it says of them."""
    pumps = sorted(f"data/skab/other/{path.name}" for path in (DATA / "skab" / "other").glob("*.csv"))
    orders = ("--channels", "Accelerometer1RMS,Accelerometer2RMS", "--speed-rpm", "15", "--fs", "1")
    yield Call("orders against the first", tuple(pumps), (*orders, "--baseline", pumps[0]))
    yield Call(
        "bearing",
        tuple(pumps),
        ("--channels", "Current", "--speed-rpm", "15", "--fs", "1", "--bearing", "6205-2RS"),
    )
    vectors = sorted(f"data/rk4_rotor_kit/{path.name}" for path in (DATA / "rk4_rotor_kit").glob("*.csv"))
    yield Call("rotor", tuple(vectors), ("--probes", "p1x_re,p1x_im", *ROSS_ROTOR[2:], "--speed-rpm", "1200"))
    motors = sorted(f"data/{path.relative_to(DATA)}" for path in (DATA / "mrecio_motors").rglob("*.dat"))
    yield Call("bearing", tuple(motors), ("--channels", "x", "--speed-rpm", "3000", "--bearing", "6205-2RS"))


GROUPS: Mapping[str, Callable[[], Iterator[Call]]] = {
    "cwru": _cwru,
    "mfpt": _mfpt,
    "adi": _adi,
    "ross": _ross,
    "logs": _logs,
    "others": _others,
}


def recordings(group: str) -> dict[str, str]:
    """Golden text of a group; none if there are no recordings.

    Raises:
        LookupError: a recording in the folder is in no group.
    """
    if not DATA.is_dir():
        return {}
    _see_that_none_is_left_out()
    lines: list[str] = []
    kept: dict[str, list[Any]] = {}
    with workplace() as folder:
        (folder / "data").symlink_to(DATA)
        for path in RECORDED.glob("*.toml"):
            (folder / "machines" / path.name).write_bytes(path.read_bytes())
        for call in GROUPS[group]():
            told = answer(*call.arguments)
            if "there is no such file" in told.out + told.err:
                raise LookupError(f"{told}\nA recording or a machine file of guard.recordings is not there")
            out = _WRITTEN.sub(r"\1<time>", told.out)
            said = out.splitlines() if out else [""]
            for recording, line in zip(
                call.recordings,
                said if len(said) == len(call.recordings) else [out] * len(call.recordings),
                strict=True,
            ):
                name = f"{call.verb} {recording.removeprefix('data/')}, {call.title}"
                whole = _CODE.sub("", f"{line}\n{told.err}\n{told.code}\n")
                lines.append(
                    f"{name}: {_in_short(line, told.err, told.code)} "
                    f"{hashlib.sha256(whole.encode()).hexdigest()}"
                )
                kept[name] = [line, told.err, told.code]
    now = CACHE / "now" / f"recordings-{group}.json"
    now.parent.mkdir(parents=True, exist_ok=True)
    now.write_text(json.dumps(kept, indent=0), encoding="utf-8")
    return {f"recordings-{group}.txt": "\n".join(lines) + "\n"}


def _in_short(line: str, err: str, code: int | str) -> str:
    try:
        said = json.loads(line)
    except ValueError:
        return f"exit code {code}, {_cut(_CODE.sub('', err.strip()) or 'nothing said')};"
    if said.get("refused"):
        return f"refused: {_cut(said['refused'])};"
    if "verdict" not in said or not isinstance(said["verdict"], str):
        return "calibrated;" if "verdict" not in said else "no verdict;"
    return f"{said['verdict']} of {'/'.join(said.get('group', ()))};"


def _cut(text: str) -> str:
    """A message on a line of its own; the digest is of the whole."""
    return text if len(text) <= _MOST_CHARACTERS else f"{text[: _MOST_CHARACTERS - 4]} ..."


def differences(group: str) -> str:
    """Where the JSON of a group differs from what was taken on this machine, key by key; empty if unknown."""
    now, taken = (CACHE / when / f"recordings-{group}.json" for when in ("now", "taken"))
    if not (now.exists() and taken.exists()):
        return ""
    before, after = (json.loads(path.read_text(encoding="utf-8")) for path in (taken, now))
    return "\n".join(islice(_different(before, after, ""), 40))


def _different(before: Any, after: Any, path: str) -> Iterator[str]:
    if isinstance(before, str) and isinstance(after, str) and before[:1] == after[:1] == "{":
        before, after = json.loads(before), json.loads(after)
    if isinstance(before, dict) and isinstance(after, dict):
        for key in [*before, *(key for key in after if key not in before)]:
            yield from _different(before.get(key, "(none)"), after.get(key, "(none)"), f"{path}.{key}")
    elif isinstance(before, list) and isinstance(after, list) and len(before) == len(after):
        for number, (one, other) in enumerate(zip(before, after, strict=True)):
            yield from _different(one, other, f"{path}[{number}]")
    elif before != after:
        yield f"{path.removeprefix('.')}: {str(before)[:100]} -> {str(after)[:100]}"


def keep_taken(group: str) -> None:
    """Keep the JSON of this run as what was taken."""
    now, taken = (CACHE / when / f"recordings-{group}.json" for when in ("now", "taken"))
    if now.exists():
        taken.parent.mkdir(parents=True, exist_ok=True)
        taken.write_bytes(now.read_bytes())


def _see_that_none_is_left_out() -> None:
    judged = {"cwru", "mfpt", "adi_cbm", "ross", "can", "skab", "rk4_rotor_kit", "mrecio_motors"}
    for path in sorted(DATA.rglob("*")):
        first = path.relative_to(DATA).parts[0]
        if path.is_file() and first not in judged | TABLES_OF_RESULTS and path.suffix not in NO_RECORDINGS:
            raise LookupError(f"{path} is in no group of guard.recordings; add it to one")
