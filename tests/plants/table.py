"""Write the tables of docs/plants.md anew: what the product says of machines that nobody modelled.

    python -m plants.table FOLDER [--aside | --drawn] [--seed N]

Without either of the half of the geometries that thresholds were chosen with; ``--aside`` of the other half,
``--drawn`` of the machines that were drawn by lot.
"""

from __future__ import annotations

import argparse
import sys
from collections import Counter
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING

from plants.bank import bank_answers, bank_beside, bank_scored, bank_summary, parts_of
from plants.diagram import draw
from plants.score import CLEAR, MODELLED, ONLY_1X, SNR_DB, TRUTH, Said, scored

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence

PAGE = Path(__file__).parents[2] / "docs" / "plants.md"
BEGIN, END = "<!-- table: make bench-diagnosis ({}) -->", "<!-- end of table ({}) -->"
_PARTS = {"aside": "set aside", "drawn": "drawn"}
_CALLED = {"tuned": "tuned half", "set aside": "set aside half", "drawn": "drawn machines"}
_BINS = (0.0, 0.5, 0.7, 0.9, 0.99, 1.01)


def share(said: Sequence[Said], of: Callable[[Said], bool]) -> str:
    """Part of the runs in percent."""
    return f"{100.0 * sum(map(of, said)) / len(said):.1f}" if said else "-"


def named(said: Iterable[Said]) -> list[Said]:
    """Runs in which a modelled fault, large enough to be named, befell a machine whose baseline was there."""
    return [s for s in said if s.fault in TRUTH and s.moved >= CLEAR and not s.refused]


def summary(said: Sequence[Said]) -> list[str]:
    """One row for every ratio."""
    lines = [
        "| SNR | modelled: right | told | wrong | unmodelled: misnamed | false alarms / 1000 rev | refused |",
        "|---|---|---|---|---|---|---|",
    ]
    for snr in SNR_DB:
        at = [s for s in said if s.snr_db == snr]
        modelled = named(at)
        others = [s for s in at if s.fault not in {*TRUTH, "healthy"} and not s.refused]
        healthy = sum(s.revolutions_before for s in at)
        alarms = sum(s.alarms_before for s in at if not s.refused)
        lines.append(
            f"| {snr} dB | {share(modelled, lambda s: s.right)} % | {share(modelled, lambda s: s.told)} % | "
            f"{share(modelled, lambda s: s.wrong)} % of {len(modelled)} | "
            f"{share(others, lambda s: s.misnamed)} % of {len(others)} | "
            f"{1000.0 * alarms / max(healthy, 1.0):.2f} ({healthy:.0f} rev) | "
            f"{sum(bool(s.refused) for s in at)} of {len(at)} |"
        )
    return lines


def answers(said: Sequence[Said], snr_db: int) -> list[str]:
    """What each fault is called at one ratio, the commonest answer first."""
    lines = [f"| fault, {snr_db} dB | runs | answers |", "|---|---|---|"]
    for fault in dict.fromkeys(s.fault for s in said):
        runs = [s for s in said if s.fault == fault and s.snr_db == snr_db and not s.refused]
        if fault in TRUTH:
            runs = [s for s in runs if s.moved >= CLEAR]
        found = Counter(" or ".join(sorted(s.names)) or s.decision for s in runs)
        told = ", ".join(f"{name.replace('_', ' ')} {count}" for name, count in found.most_common())
        lines.append(f"| {fault} | {len(runs)} | {told} |")
    return lines


def certain(said: Said) -> float:
    """Probability of what was said; that of the pair where 1X alone cannot tell."""
    return sum(
        said.probabilities.get(n, 0.0) for n in (ONLY_1X if said.decision in ONLY_1X else {said.decision})
    )


def first_names(said: Sequence[Said]) -> list[Said]:
    """Runs in which a fault, modelled or not, got the name of a modelled one, first in its group or alone."""
    return [s for s in said if s.named and not s.refused and s.fault != "healthy" and s.decision in MODELLED]


def reliability(said: Sequence[Said]) -> list[str]:
    """How often a first name is true, of all faults, by the probability that it was given with."""
    lines = ["| probability of the first name | names | true |", "|---|---|---|"]
    for low, high in pairwise(_BINS):
        at = [s for s in first_names(said) if low <= certain(s) < high]
        true = share(at, lambda s: s.decision in s.true_names)
        lines.append(f"| {low:g} to {min(high, 1.0):g} | {len(at)} | {true} % |")
    return lines


def main(arguments: Sequence[str]) -> int:
    """Judge, print and write."""
    parser = argparse.ArgumentParser(prog="make bench-diagnosis", description="Write docs/plants.md anew.")
    parser.add_argument("folder", type=Path)
    parser.set_defaults(part="tuned")
    parts = parser.add_mutually_exclusive_group()
    for name, what in (("aside", "the half that was set aside"), ("drawn", "the machines drawn by lot")):
        parts.add_argument(f"--{name}", dest="part", action="store_const", const=_PARTS[name], help=what)
    parser.add_argument("--seed", type=int, default=0, help="of the noise, and of what is stated wrongly")
    options = parser.parse_args(arguments)
    part, seed = options.part, options.seed
    bank, others, without = parts_of(bank_scored(options.folder, part=part, seed=seed))
    _put(f"bank, {part}", [bank_summary(bank), *(bank_answers(bank, snr) for snr in SNR_DB)], seed)
    _put(f"bank beside, {part}", [bank_beside(others, without)], seed)
    names = {}
    for run_up, place in ((False, part), (True, f"{part}, run-up")):
        said = scored(options.folder, part=part, seed=seed, run_up=run_up)
        _put(place, [summary(said), reliability(said), *(answers(said, snr) for snr in SNR_DB)], seed)
        known = "with a run-up" if run_up else "as stated"
        names[f"{_CALLED[part]}, {known}"] = [
            (certain(s), s.decision in s.true_names) for s in first_names(said)
        ]
    if not seed:
        draw(names, PAGE.with_name(f"plants-{part.replace(' ', '-')}.svg"))
    return 0


def _put(what: str, parts: Sequence[Sequence[str]], seed: int) -> None:
    """Print tables, and write them to their place in the page; other seeds are only looked at."""
    table = "\n\n".join("\n".join(lines) for lines in parts)
    print(table)  # noqa: T201
    if seed:
        return
    begin, end = BEGIN.format(what), END.format(what)
    page = PAGE.read_text(encoding="utf-8")
    before, rest = page.split(begin)
    PAGE.write_text(f"{before}{begin}\n{table}\n{end}{rest.split(end)[1]}", encoding="utf-8")


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
