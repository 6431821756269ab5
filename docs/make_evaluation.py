"""Make the tables of docs/evaluate.md from the figures on the other pages: ``make evaluation``.

No figure is written here: each is looked up on the page that has its measurement. A page that has lost
what is looked up ends the program with its name.
"""

from __future__ import annotations

import re
import sys
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

DOCS = Path(__file__).parent
EVALUATION = "evaluate.md"
BEGIN, END = "<!-- table: make evaluation ({}) -->", "<!-- end of table ({}) -->"
HEAD = "| what | measured | how, and the command that measures again |\n|---|---|---|"
SNR_DB = ("20 dB", "10 dB", "0 dB")


class FigureIsMissingError(Exception):
    """A page no longer has what is quoted of it."""


class Page:
    """A page of the documentation, and what it has.

    Args:
        docs: the folder of all pages.
        name: of its file.
    """

    def __init__(self, docs: Path, name: str) -> None:
        self.name = name
        self._text = (docs / name).read_text("utf-8")

    def row(self, first_cell: str, *, after: str = "") -> dict[str, str]:
        """A row of a table, by its headings.

        Args:
            first_cell: what its first cell holds.
            after: a text before the table.

        Raises:
            FigureIsMissingError: there is none.
        """
        head: list[str] = []
        for line in self._text[self._place(after) :].splitlines():
            if not line.startswith("|"):
                head = []
                continue
            cells = [cell.strip() for cell in line.strip().strip("|").split("|")]
            if not head:
                head = cells
            elif cells[0] == first_cell:
                return dict(zip(head, cells, strict=True))
        raise FigureIsMissingError(f"{self.name}: no row {first_cell!r} after {after!r}")

    def find(self, pattern: str) -> re.Match[str]:
        """What a pattern finds first.

        Raises:
            FigureIsMissingError: nothing.
        """
        found = re.search(pattern.replace(" ", r"\s+"), self._text)
        if found is None:
            raise FigureIsMissingError(f"{self.name}: nothing like {pattern!r}")
        return found

    def all(self, pattern: str) -> list[str]:
        """All that a pattern finds.

        Raises:
            FigureIsMissingError: nothing.
        """
        if found := re.findall(pattern, self._text):
            return found
        raise FigureIsMissingError(f"{self.name}: nothing like {pattern!r}")

    def _place(self, text: str) -> int:
        if text not in self._text:
            raise FigureIsMissingError(f"{self.name}: no {text!r}")
        return self._text.index(text)


class Row(NamedTuple):
    """One line of a table.

    Attributes:
        what: was measured.
        measured: the figures.
        how: on what, in a few words.
        command: that measures again.
        page: the page that has all of it, with its heading.
    """

    what: str
    measured: str
    how: str
    command: str
    page: str

    def __str__(self) -> str:
        return f"| [{self.what}]({self.page}) | {self.measured} | {self.how}: `{self.command}` |"


def paper(docs: Path) -> Iterator[Row]:
    """The paper's experiments."""
    page, again = Page(docs, "reproduce.md"), "daqsvc reproduce --out DIR"
    verdicts = page.all(r"(?m)^\|.*\| (yes|no) \|")
    yield Row(
        "statements of the paper that could be compared",
        f"{verdicts.count('yes')} of {len(verdicts)} agree",
        "each experiment of section V from scratch; the page gives the reasons of the others",
        again,
        "reproduce.md#results",
    )
    rule = r"this service's rule \(CUSUM of log-likelihood ratios\): {}"
    delay = page.find(rule.format(r"median delay .*?; 0 dB: ([\d. /]+); "))
    yield Row(
        "median delay of the rotor bank, 0 dB",
        f"{delay[1]} revolutions",
        "damping from 0.18 to 0.10, 0.06 and 0.02; 100 draws of the sensor noise",
        again,
        "reproduce.md#results",
    )
    wrong = page.find(
        rule.format(
            r"wrong changes of the declared mode per 1000 rev -5 dB: (\d+); 0 dB: (\d+); \+5 dB: (\d+)"
        )
    )
    old = page.find(
        r"the paper's rule \(.*?\): wrong changes .*? -5 dB: (\d+); 0 dB: (\d+); \+5 dB: (\d+)",
    )
    yield Row(
        "wrong changes of the declared mode, per 1000 revolutions",
        f"{', '.join(wrong.groups())} at -5, 0, +5 dB; by the paper's own rule {', '.join(old.groups())}",
        "the same draws",
        again,
        "reproduce.md#results",
    )
    figures, wrong_of = Page(docs, "rotor-figures.md"), "wrong changes in 32,234 revolutions"
    for snr in ("-5 dB", "0 dB", "+5 dB"):
        row = figures.row(snr)
        yield Row(
            f"the same by 200 seeds, {snr}",
            f"median {row['median']} revolutions; {row[wrong_of]} {wrong_of}",
            "beside it on the page: a detector that knows when the machine changes, and to what",
            "DAQSVC_SEEDS=200 pytest -s tests/rotor/test_rotor_detection.py",
            "rotor-figures.md#the-papers-scenario-200-seeds-a-level",
        )
    prediction = Page(docs, "detectability.md")
    for change in ("F1 to F1L2", "N to unbalance x1.3", "N to stiffness 0.95", "N to rub"):
        row = prediction.row(change, after="## How accurate it is")
        delay = row["delay in revolutions, predicted / seen"]
        yield Row(
            f"delay that `daqsvc detectability` predicts, {change}, {row['SNR']}",
            f"{delay} revolutions, predicted / seen",
            "simulated machines with another integrator",
            "pytest -s tests/rotor/test_detectability_comes_true.py",
            "detectability.md#how-accurate-it-is",
        )


def rotors(docs: Path) -> Iterator[Row]:
    """Rotors by finite elements, which nobody modelled."""
    page, again = Page(docs, "plants.md"), 'make bench-diagnosis ARGS="--drawn"'
    place = "plants.md#the-machines-drawn-by-lot"
    calibrated = {
        "modelled: right": "named right",
        "told": "truth in the group",
        "wrong": "wrong",
        "unmodelled: misnamed": "misnamed",
        "false alarms / 1000 rev": "false alarms per 1000 revolutions",
        "refused": "refused",
    }
    for table, title, columns in (
        ("{}", "calibrated rotor", calibrated),
        ("{}, run-up", "calibrated rotor with a run-up", calibrated),
        (
            "bank, {}",
            "rotor bank from a run-up",
            {
                "right": "named right",
                "told": "truth in the group",
                "wrong": "wrong",
                "alone": "only the true fault named, of all changes",
                "alone, of predicted": "only the true fault named, of those for which it is predicted",
                "not seen": "not seen",
                "false alarms": "false alarms",
            },
        ),
    ):
        drawn, aside, tuned = (
            [page.row(snr, after=f"make bench-diagnosis ({table.format(part)})") for snr in SNR_DB]
            for part in ("drawn", "set aside", "tuned")
        )
        for column, name in columns.items():
            yield Row(
                f"{title}: {name}",
                ", ".join(row[column] for row in drawn),
                f"at {', '.join(SNR_DB)}; set aside: {', '.join(row[column] for row in aside)}; "
                f"tuned: {', '.join(row[column] for row in tuned)}",
                again,
                place,
            )
    for name in ("0.9 to 0.99", "0.5 to 0.7"):
        row = page.row(name, after="make bench-diagnosis (drawn)")
        yield Row(
            f"how often a name given with a probability of {name} is true",
            f"{row['true']} of {row['names']}",
            "the drawn machines as stated, all ratios",
            again,
            place,
        )


def bearings(docs: Path) -> Iterator[Row]:
    """Bearings: measured records, and simulated ones with two sensors."""
    page = Page(docs, "race-test.md")
    for name, how in (
        ("CWRU DE, whole", "Case Western, drive end, 12 kHz; the sensor on the bearing"),
        ("CWRU DE, windows of 2.5 s", "the same, cut"),
        ("MFPT, whole", "MFPT bearing data"),
        ("ADI Y, whole", "Analog Devices' motor fault rig, CN0549; a ball is not testable there"),
        ("CWRU, good fan end of damaged machines", "what is right here is `normal`"),
        ("ADI, the other two axes", "as above; no limit was chosen with them in view"),
    ):
        row = page.row(name, after="make bench-data")
        parts = "; ".join(
            f"{part} {row[part]}" for part in ("inner", "outer", "ball", "normal") if row[part] != "-"
        )
        yield Row(
            f"race test, {name}: right / missed / wrong",
            parts,
            how,
            "make bench-data",
            "race-test.md#results",
        )
    noise = page.find(r"(\d+) windows of Gaussian noise .*?: (\d+) alarms")
    yield Row(
        "false alarms in noise",
        f"{noise[2]} in {noise[1]} windows",
        "Gaussian noise, 2.5 s at 12 kHz",
        "make bench-data",
        "race-test.md#results",
    )
    other = page.find(
        r"Of (\d+) records with a damaged race (\d+) were named right, of (\d+) with a damaged ball (\w+)"
    )
    yield Row(
        "sensors away from the bearing",
        f"{other[2]} of {other[1]} damaged races named, {other[4]} of {other[3]} balls, no wrong part",
        "fan end and base plate of the CWRU rig",
        "pytest -s tests/bearing/test_race_other_sensors.py",
        "race-test.md#results",
    )
    pair, again = (
        Page(docs, "bearing.md"),
        "DAQSVC_SEEDS=200 pytest -s tests/bearing/test_bearing_isolation.py",
    )
    for line in re.findall(
        r"(?m)^\| S\d .*four classes.*$|^\| S\d .*three classes.*$", (docs / pair.name).read_text("utf-8")
    ):
        machine, noise_db, mismatch, *counts, target = (cell.strip() for cell in line.strip("|").split("|"))
        asked, _, reached = target.partition(": ")
        yield Row(
            f"two sensors, simulated machine {machine}, {noise_db}, model {mismatch} off",
            f"{reached} of the classes right; calm, inner, outer, ball {', '.join(counts)} of 200",
            f"200 machines a class; asked: {asked.replace('>=', 'at least')}",
            again,
            "bearing.md#which-race-and-whether-at-all",
        )


def speed(docs: Path) -> Iterator[Row]:
    """What it costs."""
    cost = Page(docs, "driver-contract.md")
    for name in (
        "three channels of 3.2 kS/s over CAN FD, levels and a rotor bank",
        "500 lines of text a second, levels",
    ):
        row = cost.row(name)
        yield Row(
            f"{name}",
            f"{row['the whole service']} CPU seconds a second",
            "the whole service, x86-64, two cores that others use as well",
            "make bench",
            "driver-contract.md",
        )
    ladder = Page(docs, "several-machines.md").row("64", after="## What a machine costs")
    yield Row(
        "64 rotors in one service",
        f"{ladder['CPU s a second']} of one core, {ladder['resident MB']} MB, "
        f"loop lag p99 {ladder['lag p99, ms']} ms",
        "two probes and a keyphasor at 640 Hz each, levels, a bank of ten models; no sample lost",
        "make bench",
        "several-machines.md#what-a-machine-costs",
    )
    bank = Page(docs, "rotor-figures.md").row("machine runs free, million samples/s")
    yield Row(
        "rotor bank of ten models, one with rub",
        f"{bank['64']} million samples a second",
        "blocks of 64 samples, one core, the bank alone",
        "make bench",
        "rotor-figures.md#speed",
    )
    modbus = Page(docs, "modbus.md").find(r"over TCP on one machine: ([\d.]+ to [\d.]+) of")
    yield Row(
        "Modbus TCP polls, beside a bare pymodbus loop",
        f"{modbus[1]} of its rate",
        "loopback; with samples placed in time as the result",
        "make bench",
        "modbus.md#speed",
    )
    screen = Page(docs, "page.md")
    yield Row(
        "from sample to screen, 95 %",
        screen.row("from sample to screen, 95 %")["measured"],
        "the page in Chromium, a paper rotor",
        "make bench",
        "page.md#what-it-costs",
    )
    fleet = Page(docs, "fleet.md").row("judging, one worker")
    yield Row(
        "a recording of a fleet's archive",
        f"{fleet['a recording']}; a million: {fleet['a million']}",
        "orbits of 0.19 MB, one worker of Dask",
        "make bench",
        "fleet.md#a-million-recordings",
    )


def kept(docs: Path) -> Iterator[Row]:
    """What is lost, and when a sample was taken."""
    box, outbox = Page(docs, "edge-box.md"), Page(docs, "outbox.md")
    for broker in ("mosquitto", "amqtt"):
        row = outbox.row(broker, after="make nothing-lost")
        yield Row(
            f"alarms through kills, full disks and outages, {broker}",
            f"{row['kept']} of {row['runs']} runs kept all; {row['alarm events']} alarm events, "
            f"{row['kills']} kills, {row['repeats']} repeats, "
            f"{row['lost by the broker']} lost by a broker that was killed",
            "random runs: kill -9, broker killed, network cut, disk full; a consumer counts",
            'make nothing-lost ARGS="--runs 60"',
            "outbox.md#what-was-tested",
        )
    samples, events = box.row("samples", after="## Soak"), box.row("alarm events", after="## Soak")
    yield Row(
        "ten minutes of all that happens to a box in months",
        f"samples: {samples['soak']}; alarm events: {events['soak']}",
        "six machines on buses of every kind; every sample's number is checked",
        "make soak",
        "edge-box.md#soak",
    )
    yield Row(
        "four hours of a machine's time",
        f"samples: {samples['hours']}",
        "driven clock, over Mosquitto",
        "PYTHONPATH=tests python -m soak.hour",
        "edge-box.md#soak",
    )
    align = Page(docs, "alignment.md").row("uniform, 0 to 5 ms")
    yield Row(
        "samples of two devices on one grid",
        f"error {align['median']} us median, {align['95 %']} us 95 %, {align['largest']} us at most",
        "clocks 50 ppm fast and slow, blocks late by 0 to 5 ms; worse where no block is prompt",
        "DAQSVC_SEEDS=30 pytest -s tests/acquisition/test_alignment_clocks.py",
        "alignment.md",
    )


def alarms(docs: Path) -> Iterator[Row]:
    """Alarms: how soon, and how many for nothing."""
    outbox, page = Page(docs, "outbox.md"), Page(docs, "alarms.md")
    for what in ("decision to disk", "decision to the broker's acknowledgement"):
        row = outbox.row(what, after="make bench (alarms)")
        yield Row(
            f"from {what}",
            f"median {row['median']}, 99 % {row['99 %']}",
            "one alarm after another, Mosquitto on the same machine",
            "make bench",
            "outbox.md#how-fast",
        )
    many = page.find(r"with 10,000 sensors a diagnosis takes ([\d.]+ to [\d.]+) times as long as with 10")
    yield Row(
        "a diagnosis among 10,000 sensors",
        f"{many[1]} times what it costs among 10",
        "alarms of the others are not evaluated",
        "make bench",
        "alarms.md",
    )
    gaps = page.row("10 %", after="## Missing samples")
    yield Row(
        "RMS with 10 % of the samples lost",
        f"off by {gaps['RMS']} %",
        "mean and standard deviation, 300 windows; single samples",
        "DAQSVC_SEEDS=300 pytest -s tests/detectors/levels/test_levels_of_gaps.py",
        "alarms.md#missing-samples",
    )
    orders = Page(docs, "order-change.md").find(
        r"(\d+) alarms in (\d+) simulated pairs of unchanged machines"
    )
    yield Row(
        "order change of accelerometers, no keyphasor",
        f"{orders[1]} false alarms in {orders[2]} pairs",
        "simulated machines that have not changed",
        "pytest -s tests/rotor/test_order_change_adi.py",
        "order-change.md#what-was-measured",
    )


TABLES: dict[str, Callable[[Path], Iterator[Row]]] = {
    "paper": paper,
    "rotors": rotors,
    "bearings": bearings,
    "speed": speed,
    "nothing lost": kept,
    "alarms": alarms,
}


def evaluation(docs: Path) -> str:
    """The text of the page with its tables made again.

    Args:
        docs: the folder of all pages.

    Raises:
        FigureIsMissingError: a page no longer has what is quoted of it.
    """
    text = (docs / EVALUATION).read_text("utf-8")
    for name, rows in TABLES.items():
        begin, end = BEGIN.format(name), END.format(name)
        before, rest = text.split(begin)
        try:
            table = "\n".join([HEAD, *map(str, rows(docs))])
        except KeyError as column:
            raise FigureIsMissingError(f"table {name!r}: no column {column}") from column
        text = f"{before}{begin}\n{table}\n{end}{rest.split(end)[1]}"
    return text


if __name__ == "__main__":
    try:
        (DOCS / EVALUATION).write_text(evaluation(DOCS), "utf-8")
    except FigureIsMissingError as missing:
        sys.exit(f"make_evaluation: {missing}; correct docs/make_evaluation.py or that page")
