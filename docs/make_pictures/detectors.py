"""What each detector sees on a simulated machine, healthy and faulty, and what it states meanwhile."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from daqsvc.bearing.geometry import bearing_orders
from daqsvc.bearing.race import race_test
from daqsvc.bearing.race.verdict import PARTS
from daqsvc.diagnosis.recorded import listen
from daqsvc.settings.load import parse_machine_file
from daqsvc.settings.plugins import configured
from make_pictures.style import BLACK, FAULTY, GOOD, HEALTHY, OTHERS, QUIET, new
from sim_hw.plants import rotor
from sim_hw.scenario import BearingPlant, BearingScenario, RaceDamage

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from numpy.typing import NDArray

    from daqsvc.bearing.race.verdict import RaceVerdict
    from daqsvc.diagnosis.record import Diagnosis
    from daqsvc.settings import MachineFile

    Floats = NDArray[np.float64]

MACHINES = Path(__file__).parents[2] / "config" / "machines"
G_M_S2 = 9.80665
CLEARANCE_UM, NOISE_UM = 100.0, 2.0
LEAST_PROBABILITY = 0.05
"""What was never more probable is not drawn."""
CALIBRATE_REV = 50
SPALL_S, END_S = 15.0, 35.0
POINTS = 500
"""Of a spectrum: the largest of each of so many stretches."""


class Watched(NamedTuple):
    """A machine that was watched by a detector.

    Attributes:
        machine: its file.
        samples: float64 ``[n, channels]``, all of it.
        rate_hz: sampling rate.
        onset: the first sample with the fault.
        stated: what the detector stated.
    """

    machine: MachineFile
    samples: Floats
    rate_hz: float
    onset: int
    stated: Sequence[Diagnosis]


def machine_of(example: str, *changes: tuple[str, str]) -> MachineFile:
    """An example of a machine file, with some of its text changed."""
    text = (MACHINES / f"{example}.toml").read_text("utf-8")
    for old, new_text in changes:
        if old not in text:
            raise ValueError(f"{example}.toml has no {old!r}")
        text = text.replace(old, new_text)
    return parse_machine_file(text, MACHINES / f"{example}.toml")


def watch(machine: MachineFile, key: str, samples: Floats, onset: int) -> Watched:
    """Have the detector of a machine file judge samples, as it does on a bus."""
    [(plugin, settings)] = [(p, s) for name, p, s in configured(machine.pipeline) if name == key]
    [detector] = plugin.build(machine, settings, None)
    rate_hz = machine.streams[detector.stream].rate_hz
    return Watched(machine, samples, rate_hz, onset, list(listen(detector, samples, rate_hz)))


def rotor_run(healthy: rotor.PlantParameters, faulty: rotor.PlantParameters, at: float, end: float) -> Floats:
    """Two probes in um and a keyphasor in V of a rotor that changes; 64 samples a revolution."""
    motion = rotor.simulate(healthy, [rotor.Change(at, faulty)], revolutions=end)
    noise = np.random.default_rng(1).normal(0.0, NOISE_UM, (len(motion.x), 2))
    probes = np.column_stack(motion.in_um(CLEARANCE_UM)) + noise
    return np.column_stack([probes, rotor.keyphasor_voltage(motion.revolution)])


def paper_rotor(key: str) -> Watched:
    """The paper's rotor at its critical speed; at revolution 30 its damping is lost and it rubs."""
    healthy = rotor.PlantParameters()
    samples = rotor_run(healthy, replace(healthy, damping_ratio=0.02), 30.0, 60.0)
    return watch(machine_of("laval-rig"), key, samples, 30 * 64)


def panels(title: str, height_in: float = 4.7) -> tuple[Figure, Axes, Axes, Axes]:
    """Healthy on the left, faulty on the right, and below both what is stated over time."""
    figure = new(height_in)
    figure.suptitle(title, fontsize=10.5, x=0.01, ha="left")
    axes = figure.subplot_mosaic([["healthy", "faulty"], ["stated", "stated"]], height_ratios=(1.6, 1.0))
    axes["healthy"].set_title("healthy", color=HEALTHY)
    axes["faulty"].set_title("faulty", color=FAULTY)
    return figure, axes["healthy"], axes["faulty"], axes["stated"]


def begins(axes: Axes, at: float) -> None:
    """Mark when the fault begins."""
    axes.axvline(at, color=BLACK, linestyle=":", linewidth=1.3)
    axes.text(at, 1.02, "fault begins", transform=axes.get_xaxis_transform(), fontsize=8.5, ha="center")


def probabilities(
    axes: Axes, at: Sequence[float], stated: Sequence[Diagnosis], names: Mapping[str, str]
) -> None:
    """How probable each name is from each statement on, by what it is called; grey: data were not good."""
    for (name, label), color in zip(names.items(), OTHERS, strict=False):
        values = [one.probabilities.get(name, 0.0) if one.quality == "good" else np.nan for one in stated]
        axes.step(at, values, where="post", color=color, linewidth=1.7, label=label)
    for now, after, one in zip(at, at[1:], stated, strict=False):
        if one.quality != "good":
            axes.axvspan(now, after, color=QUIET, alpha=0.25, linewidth=0)
    axes.set_ylim(-0.04, 1.06)
    axes.set_ylabel("probability")
    axes.set_xlim(0.0, at[-1])


def probable(stated: Sequence[Diagnosis]) -> dict[str, str]:
    """What ever was probable while the data were good, and how it is written."""
    names = dict.fromkeys(name for one in stated for name in one.probabilities)
    good = [one for one in stated if one.quality == "good"]
    return {
        name: name.replace("_", " ")
        for name in names
        if max(one.probabilities.get(name, 0.0) for one in good) > LEAST_PROBABILITY
    }


def named(diagnosis: Diagnosis) -> str:
    """A statement in words."""
    return " or ".join(diagnosis.group or (diagnosis.decision,)).replace("_", " ")


def levels() -> Figure:
    """Waveforms, and the RMS against its setpoints."""
    watched = paper_rotor("levels")
    figure, healthy, faulty, below = panels(
        "Levels: RMS of a probe against its setpoints; the shaft begins to rub"
    )
    stated = [one for one in watched.stated if one.sensors == ("probe-x",)]
    span = round(0.4 * watched.rate_hz)
    for axes, end in ((healthy, watched.onset), (faulty, len(watched.samples))):
        seconds = np.arange(end - span, end) / watched.rate_hz
        axes.plot(seconds, watched.samples[end - span : end, 0], color=BLACK, linewidth=1.0)
        axes.set_ylim(-130.0, 130.0)
        axes.set_xlabel("s")
    healthy.set_ylabel("probe-x, um")
    at = [one.end_index / watched.rate_hz for one in stated]
    rms = [one.statistics["rms"] for one in stated]
    colors = [{"normal": GOOD, "alert": OTHERS[2], "danger": FAULTY}[one.severity] for one in stated]
    below.plot(at, rms, color=QUIET, linewidth=0.8)
    below.scatter(at, rms, c=colors, s=26, zorder=3)
    for name, color in (("rms.alert", OTHERS[2]), ("rms.danger", FAULTY)):
        limit = stated[-1].thresholds[name]
        below.axhline(limit, color=color, linestyle="--", linewidth=1.2)
        below.annotate(
            f"{name.removeprefix('rms.')} {limit:g} um",
            (at[0], limit),
            (0.0, 3.0),
            textcoords="offset points",
            va="bottom",
            color=color,
            fontsize=8.5,
        )
    below.set_ylabel("RMS, um")
    below.set_ylim(0.0, 1.25 * max(rms))
    below.set_xlabel("s; the colour of a point is the severity that is stated")
    begins(below, watched.onset / watched.rate_hz)
    return figure


def orbit(axes: Axes, samples: Floats, color: str, clearance_um: float | None = None) -> None:
    """Where the shaft was, and the clearance."""
    axes.plot(samples[:, 0], samples[:, 1], color=color, linewidth=0.8)
    if clearance_um is not None:
        turn = np.linspace(0.0, 2.0 * np.pi, 181)
        axes.plot(clearance_um * np.cos(turn), clearance_um * np.sin(turn), "--", color=BLACK, linewidth=1.0)
    axes.set_aspect("equal")
    axes.set_xlabel("probe-x, um")


def rotor_bank() -> Figure:
    """Orbits, and the probabilities of the modes."""
    watched = paper_rotor("rotor_bank")
    title = "Rotor bank: one observer for each mode; damping falls from 0.18 to 0.02, and the shaft rubs"
    figure, healthy, faulty, below = panels(title, 5.2)
    span = 5 * 64
    for axes, end, color in ((healthy, watched.onset, HEALTHY), (faulty, len(watched.samples), FAULTY)):
        orbit(axes, watched.samples[end - span : end], color, CLEARANCE_UM)
        axes.set_xlim(-130.0, 130.0)
        axes.set_ylim(-130.0, 130.0)
    healthy.set_ylabel("probe-y, um")
    stated = [one for one in watched.stated if one.revolutions is not None]
    [bank] = [settings for key, _, settings in configured(watched.machine.pipeline) if key == "rotor_bank"]
    modes = {m.name: f"{m.name}: damping {m.damping_ratio:g}{', rub' if m.rub else ''}" for m in bank.modes}
    probabilities(below, [one.revolutions or 0.0 for one in stated], stated, modes)
    below.legend(loc="center", bbox_to_anchor=(0.27, 0.5))
    below.set_xlabel(f"revolution; at the end it states {named(stated[-1])}")
    begins(below, watched.onset / 64)
    return figure


def rotor_synchronous() -> Figure:
    """The 1X vector of each revolution, and the probabilities of the causes."""
    healthy_rotor = rotor.PlantParameters(damping_ratio=0.1, speed_ratio=25.0 / 31.0, eccentricity=0.06)
    samples = rotor_run(healthy_rotor, replace(healthy_rotor, stiffness=0.9), 90.0, 150.0)
    machine = machine_of(
        "rotor-synchronous", ("calibrate_revolutions = 50", f"calibrate_revolutions = {CALIBRATE_REV}")
    )
    watched = watch(machine, "rotor_synchronous", samples, 90 * 64)
    title = "Rotor, synchronous: each revolution against the healthy ones; the stiffness falls by a tenth"
    figure, healthy, faulty, below = panels(title, 5.0)
    vectors = whirl(watched.samples)
    turn = watched.onset // 64
    for axes, part, color in ((healthy, slice(0, turn), HEALTHY), (faulty, slice(turn + 10, None), FAULTY)):
        axes.plot(vectors[:turn].real, vectors[:turn].imag, ".", color="#b9cfdf", markersize=3)
        axes.plot(vectors[part].real, vectors[part].imag, ".", color=color, markersize=4)
        mean = vectors[part].mean()
        axes.annotate(
            "", (mean.real, mean.imag), (0.0, 0.0), arrowprops={"arrowstyle": "-|>", "color": color}
        )
        axes.plot(0.0, 0.0, "+", color=BLACK)
        axes.set_xlim(-2.0, 16.0)
        axes.set_ylim(-11.0, 2.0)
        axes.set_aspect("equal")
        axes.set_xlabel("1X of the orbit, um, real part")
    healthy.set_ylabel("imaginary part")
    # While all is well it states "normal" without weighing causes; before that it calibrates.
    stated = [
        replace(one, probabilities={"normal": 1.0}) if one.decision == "normal" else one
        for one in watched.stated
        if one.revolutions is not None
    ]
    at = [one.revolutions or 0.0 for one in stated]
    probabilities(below, at, stated, probable(stated))
    for decision, style in (("departure", "--"), (stated[-1].decision, "-.")):
        told = next(one.revolutions for one in stated if one.decision == decision)
        text = decision if decision == "departure" else "named"
        below.axvline(
            told or 0.0, color=FAULTY, linestyle=style, linewidth=1.1, label=f"{text}, revolution {told:g}"
        )
    below.axvspan(0.0, CALIBRATE_REV, color=HEALTHY, alpha=0.12, linewidth=0)
    below.text(CALIBRATE_REV / 2, 0.5, "calibrates", ha="center", color=HEALTHY, fontsize=9)
    below.legend(loc="center", bbox_to_anchor=(0.5, 0.5))
    below.set_xlabel(f"revolution; at the end it states {named(stated[-1])}")
    begins(below, turn)
    return figure


def whirl(samples: Floats) -> NDArray[np.complex128]:
    """The forward 1X of each revolution in um, complex128 ``[n]``; 64 samples each."""
    turns = (samples[:, 0] + 1j * samples[:, 1]).reshape(-1, 64)
    return np.asarray((turns * np.exp(-2j * np.pi * np.arange(64) / 64)).mean(axis=1))


def bearing() -> Figure:
    """Envelope spectra with the lines of each part, and the probabilities of the parts."""
    machine = machine_of("bearing", ("calibrate_s = 30.0", "calibrate_s = 10.0"))
    speed_rpm, rate_hz = machine.machine.speed_rpm, machine.streams["housing"].rate_hz
    scenario = BearingScenario(
        title="a spall",
        duration_s=END_S,
        plant=BearingPlant(kind="bearing", speed_rpm=speed_rpm, spall_depth_um=0.08, snr_db=0.0),
        damage=(RaceDamage(part="outer", at_s=SPALL_S),),
    )
    run = scenario.accelerations(rate_hz)
    fan_end = np.random.default_rng(2).normal(0.0, 0.01, len(run.housing_m_s2))
    samples = np.column_stack([run.housing_m_s2 / G_M_S2, fan_end])
    watched = watch(machine, "bearing", samples, round(SPALL_S * rate_hz))
    figure, healthy, faulty, below = panels(
        "Bearing: lines of its parts in the envelope; the outer race spalls", 5.0
    )
    span = round(10.0 * rate_hz)
    for axes, end in ((healthy, watched.onset), (faulty, len(samples))):
        envelope(
            axes, race_test(samples[end - span : end, 0], rate_hz, speed_rpm, bearing_orders("6205-2RS"))
        )
    healthy.set_ylabel("modulation of the envelope")
    # Above the axes: within them it would cover lines.
    healthy.legend(loc="lower right", bbox_to_anchor=(1.0, 0.98), ncols=3, borderpad=0.0, columnspacing=1.2)
    probabilities(
        below, [one.end_index / rate_hz for one in watched.stated], watched.stated, probable(watched.stated)
    )
    below.legend(loc="center", bbox_to_anchor=(0.2, 0.5))
    below.set_xlabel(f"s; at the end it states {named(watched.stated[-1])}")
    begins(below, SPALL_S)
    return figure


def envelope(axes: Axes, verdict: RaceVerdict) -> None:
    """An envelope's spectrum over orders, and where the lines of each part would be."""
    spectrum, last = verdict.spectrum, 15.2
    if spectrum is None:
        raise ValueError("the race test kept no spectrum")
    count = int(np.searchsorted(spectrum.order, last)) // POINTS * POINTS
    order, amplitude = (part[:count].reshape(POINTS, -1) for part in (spectrum.order, spectrum.amplitude))
    for part, color in zip(PARTS, (OTHERS[4], FAULTY, GOOD), strict=True):
        for harmonic in (1, 2, 3, 4):
            at = harmonic * verdict.evidence[part].order
            axes.axvline(
                at, color=color, linestyle="--", linewidth=0.9, label=part if harmonic == 1 else None
            )
    axes.plot(order.mean(axis=1), amplitude.max(axis=1), color=BLACK, linewidth=0.9)
    axes.set_xlim(0.0, float(order[-1].mean()))
    axes.set_ylim(0.0, 0.4)
    axes.set_xlabel("events per revolution")


DETECTORS: Mapping[str, Callable[[], Figure]] = {
    "levels": levels,
    "bearing": bearing,
    "rotor_bank": rotor_bank,
    "rotor_synchronous": rotor_synchronous,
}
"""By the key of the detector's table."""
