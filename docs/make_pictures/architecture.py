"""How samples become messages, and which package may import which: from the packages and their contract."""

from __future__ import annotations

import tomllib
from importlib import import_module
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from make_pictures.style import BLACK, FAULTY, GOOD, HEALTHY, PALE, QUIET, arrow, blank, box, new

if TYPE_CHECKING:
    from collections.abc import Iterable

    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

ROOT = Path(__file__).parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))
CONTRACT = "Data flows one way through daqsvc"


class Step(NamedTuple):
    """One stop of the samples on their way.

    Attributes:
        title: what it is called.
        package: where it is in the tree.
        gives: the type that goes on from there, as ``module:name``; empty for bytes.
        plugins: the group of entry points whose names are shown in it.
    """

    title: str
    package: str
    gives: str
    plugins: str = ""


def steps() -> list[Step]:
    """The way of the samples, from the bus to the broker."""
    return [
        Step("bus", "", "", "daqsvc.drivers"),
        Step("driver", "drivers", "drivers.frames:DecodedBatch"),
        Step("time base", "daqsvc.acquisition", "daqsvc.acquisition.samples:SampleBlock"),
        Step("ring", "daqsvc.acquisition.ring", "daqsvc.acquisition.samples:Window"),
        Step("detectors", "daqsvc.detectors", "daqsvc.diagnosis.record:Diagnosis", "daqsvc.detectors"),
        Step("alarms", "daqsvc.alarms", "daqsvc.alarms.events:AlarmEvent"),
        Step("outbox", "daqsvc.outbox", "daqsvc.outbox.messages:OutboxMessage"),
        Step("outputs", "daqsvc.publish", "", "daqsvc.outputs"),
    ]


def layers() -> list[list[str]]:
    """The layers of daqsvc as `make check` holds to them, the highest first."""
    contracts = PROJECT["tool"]["importlinter"]["contracts"]
    [found] = [one["layers"] for one in contracts if one["name"] == CONTRACT]
    return [[name.strip() for name in layer.split("|")] for layer in found]


def check_order(way: list[Step]) -> None:
    """See that each step of the service may import the one before it, by the contract.

    Raises:
        ValueError: one may not: the picture would be wrong.
    """
    heights = {name: -number for number, layer in enumerate(layers()) for name in layer}
    rooms = [step.package.split(".")[1] for step in way if step.package.startswith("daqsvc.")]
    climbed = [heights[room] for room in rooms]
    if climbed != sorted(climbed):
        raise ValueError(f"pyproject.toml has {rooms} in another order")


def given(step: Step) -> str:
    """The name of what a step hands on; it must be there."""
    module, _, name = step.gives.partition(":")
    if step.package:
        import_module(step.package)
    return getattr(import_module(module), name).__name__ if module else ""


def wrapped(names: Iterable[str], width: int = 24) -> list[str]:
    """Names of plugins in lines that fit into a box; a comma ends each line but the last."""
    lines = [""]
    for name in names:
        if lines[-1] and len(lines[-1]) + len(name) + 2 > width:
            lines[-1] += ","
            lines.append("")
        lines[-1] += f"{', ' if lines[-1] else ''}{name}"
    return lines


def flow() -> Figure:
    """The way of the samples in two rows, with what is handed on above each arrow."""
    way = steps()
    check_order(way)
    figure = new(4.0)
    axes = blank(figure, 700.0, 384.0)
    size, columns = (142.0, 96.0), (78.0, 259.0, 440.0, 621.0)
    places = [(x, 308.0) for x in columns] + [(x, 166.0) for x in reversed(columns)]
    for step, place in zip(way, places, strict=True):
        lines = [step.title, *([step.package.replace(".", "/")] if step.package else [])]
        if step.plugins:
            lines += wrapped(sorted(PROJECT["project"]["entry-points"][step.plugins]))
        box(axes, place, size, lines, HEALTHY)
    for number, (here, there) in enumerate(pairwise(places)):
        name = given(way[number]) or "frames"
        if here[1] == there[1]:
            side = 1.0 if there[0] > here[0] else -1.0
            arrow(axes, (here[0] + side * size[0] / 2, here[1]), (there[0] - side * size[0] / 2, there[1]))
            middle = ((here[0] + there[0]) / 2, here[1] + size[1] / 2 + 10)
            axes.text(*middle, name, ha="center", fontsize=8, color=BLACK)
        else:
            arrow(axes, (here[0], here[1] - size[1] / 2), (there[0], there[1] + size[1] / 2))
            axes.text(here[0] - 6, (here[1] + there[1]) / 2, name, ha="right", va="center", fontsize=8)
    arrow(axes, (places[-1][0], places[-1][1] - size[1] / 2), (places[-1][0], 72.0))
    axes.text(8.0, 58.0, "MQTT broker, Prometheus, browser", ha="left", fontsize=8, color=QUIET)
    people(axes, places[5], size)
    return figure


def people(axes: Axes, alarms: tuple[float, float], size: tuple[float, float]) -> None:
    """Commands of people, which are logged before they are carried out."""
    import_module("daqsvc.audit")
    lines = ["commands of people", "written to the audit log, then carried out"]
    box(axes, (alarms[0], 45.0), (220.0, 52.0), lines, GOOD)
    arrow(axes, (alarms[0], 71.0), (alarms[0], alarms[1] - size[1] / 2), color=GOOD)
    name = import_module("daqsvc.alarms.commands").AlarmCommand.__name__
    axes.text(alarms[0] + 6, 94.0, name, ha="left", va="center", fontsize=8)


def driver() -> Figure:
    """What a driver does between the bus and the ring."""
    assembler = import_module("daqsvc.acquisition.assembler").StreamAssembler.__name__
    block = import_module("daqsvc.acquisition.samples").SampleBlock.__name__
    figure = new(1.55)
    axes = blank(figure, 700.0, 148.6)
    frame = ((103.0, 589.0, 589.0, 103.0), (12.0, 12.0, 132.0, 132.0))
    axes.fill(*frame, facecolor="none", edgecolor=QUIET, linestyle="--", linewidth=1.0)
    axes.text(113.0, 116.0, "driver: one link, opened again when it is lost", fontsize=8.5, color=QUIET)
    stops = (
        (44.0, 76.0, ["bus"]),
        (177.0, 126.0, ["read in bulk", "bytes, stamped"]),
        (331.0, 126.0, ["decode", "as arrays"]),
        (504.0, 150.0, [assembler, "order, loss, time"]),
        (656.0, 76.0, ["ring"]),
    )
    for x, width, lines in stops:
        box(axes, (x, 62.0), (width, 52.0), lines, HEALTHY)
    for (x1, w1, _), (x2, w2, _) in pairwise(stops):
        arrow(axes, (x1 + w1 / 2, 62.0), (x2 - w2 / 2, 62.0))
    axes.text(696.0, 98.0, block, ha="right", fontsize=8)
    return figure


def contract() -> Figure:
    """The layers: a package imports what is below it, never what is above."""
    rows = layers()
    figure = new(0.215 * len(rows) + 0.35)
    height = 20.6 * len(rows) + 34.0
    axes = blank(figure, 700.0, height)
    rule = "a package may import what is below it, and nothing above"
    axes.text(60.0, height - 18.0, rule, fontsize=9, color=QUIET)
    arrow(axes, (30.0, height - 30.0), (30.0, 12.0), color=FAULTY)
    axes.text(18.0, height / 2, "imports", rotation=90, ha="center", va="center", fontsize=9, color=FAULTY)
    for number, names in enumerate(rows):
        y = height - 34.0 - 20.6 * (number + 0.5)
        width = (620.0 - 6.0 * (len(names) - 1)) / len(names)
        for place, name in enumerate(names):
            x = 60.0 + place * (width + 6.0)
            axes.fill((x, x + width, x + width, x), (y - 8.5, y - 8.5, y + 8.5, y + 8.5), color=PALE)
            axes.text(x + width / 2, y, name, ha="center", va="center", fontsize=8.5, color=BLACK)
    return figure
