"""What the outbox does while the broker is away and the power goes, played with a real one."""

from __future__ import annotations

import asyncio
import json
import shutil
import sqlite3
import tempfile
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from daqsvc.acquisition.clock import SystemClock
from daqsvc.outbox.store import Outbox
from make_pictures.style import BLACK, FAULTY, GOOD, HEALTHY, QUIET, new

if TYPE_CHECKING:
    from matplotlib.figure import Figure

ALARM_EVERY_S, LAST_S = 2, 46
AWAY_S, OFF_S = (9, 31), (19, 25)
"""When the broker is away, and when the box is without power."""
A_SECOND = 2
"""Number of messages that go out in a second; slow, so that the picture shows their order."""
UNMARKED_S = 8
"""The broker has this one, but the power goes before the journal knows: it comes twice."""


@dataclass
class Course:
    """What happened, in seconds.

    Attributes:
        decided: when each alarm was decided, by its number.
        stored: when it was on the disk.
        arrived: what came to the broker, in order: number and time.
        waiting: how many on the disk the broker did not have: time and count.
    """

    decided: dict[int, int] = field(default_factory=dict)
    stored: dict[int, int] = field(default_factory=dict)
    arrived: list[tuple[int, float]] = field(default_factory=list)
    waiting: list[tuple[int, int]] = field(default_factory=list)


async def play(folder: Path) -> Course:
    """Let alarms happen, one every two seconds of a made-up time, through a real outbox."""
    course, number = Course(), 0
    running, lives = folder / "0", 0
    running.mkdir(mode=0o700)
    outbox = Outbox(running / "outbox.sqlite", SystemClock())
    await outbox.open()
    for second in range(LAST_S + 1):
        if second == OFF_S[0]:
            # A power cut: what is on the disk at this moment is what the next start finds.
            lives += 1
            after = folder / str(lives)
            as_of_now(running, after)
            await outbox.close()
            running = after
        if second == OFF_S[1]:
            outbox = Outbox(running / "outbox.sqlite", SystemClock())
            await outbox.open()
        if OFF_S[0] <= second < OFF_S[1]:
            continue
        if second % ALARM_EVERY_S == 0:
            number += 1
            course.decided[number] = second
            text = json.dumps({"number": number}).encode()
            await outbox.append(f"alarm/{number}", lambda _, text=text: text, retain=True)
            course.stored[number] = second
        if not AWAY_S[0] <= second < AWAY_S[1]:
            for place, message in enumerate(await outbox.pending(0, A_SECOND)):
                told = json.loads(message.payload)["number"]
                course.arrived.append((told, second + place / A_SECOND))
                if second != UNMARKED_S:
                    outbox.mark_sent(message.sequence)
        waits = len(await outbox.pending(0, 100))
        course.waiting.append((second, waits))
    await outbox.close()
    return course


def as_of_now(running: Path, after: Path) -> None:
    """What is on the disk of an outbox that is open: its databases each as of one moment.

    Copied file by file, a database and its log can be of two moments, as the outbox writes meanwhile.
    """
    after.mkdir(mode=0o700)
    for file in sorted(running.iterdir()):
        if file.suffix == ".sqlite":
            with (
                closing(sqlite3.connect(file)) as source,
                closing(sqlite3.connect(after / file.name)) as copy,
            ):
                source.backup(copy)
            (after / file.name).chmod(0o600)
        elif not file.name.endswith(("-wal", "-shm", "-journal")):
            shutil.copy2(file, after / file.name)


def picture() -> Figure:
    """Three rows: decided, on the disk, at the broker; below how many wait."""
    with tempfile.TemporaryDirectory() as folder:
        course = asyncio.run(play(Path(folder)))
    figure = new(4.0)
    upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=(2.0, 1.0))
    for row, times, color in ((2, course.decided, FAULTY), (1, course.stored, HEALTHY)):
        upper.plot(list(times.values()), [row] * len(times), "o", color=color, markersize=5)
    seen: set[int] = set()
    for number, second in course.arrived:
        again = number in seen
        seen.add(number)
        upper.plot([course.stored[number], second], [1, 0], color=QUIET, linewidth=0.7)
        upper.plot(second, 0, "o", color=GOOD, markersize=5, markerfacecolor="white" if again else GOOD)
    missing = course.stored.keys() - seen
    if missing:
        raise ValueError(f"the outbox lost {sorted(missing)}")
    repeats = len(course.arrived) - len(seen)
    upper.set_yticks([0, 1, 2], ["at the broker", "on the disk", "decided"])
    upper.set_ylim(-0.45, 2.9)
    upper.set_title(
        f"{len(course.decided)} alarms, {len(seen)} at the broker, {repeats} of them twice (hollow)"
    )
    for axes in (upper, lower):
        axes.axvspan(*AWAY_S, color=FAULTY, alpha=0.08, linewidth=0)
        axes.axvspan(*OFF_S, color=BLACK, alpha=0.14, linewidth=0)
    upper.text(AWAY_S[0] + 0.4, 2.55, "broker away", color=FAULTY, fontsize=9)
    upper.text(OFF_S[0] + 0.4, 2.55, "power cut", color=BLACK, fontsize=9)
    seconds, waits = zip(*course.waiting, strict=True)
    lower.plot(seconds, waits, ".", color=HEALTHY, markersize=4)
    lower.set_ylabel("wait on the disk")
    lower.set_ylim(bottom=-0.8)
    lower.set_xlim(-1, LAST_S + 1)
    lower.set_xlabel("s")
    return figure
