"""What a person sees of the demo: a live view in the terminal, lines in a pipe, and a summary."""

from __future__ import annotations

import shlex
from collections import deque
from typing import TYPE_CHECKING, Any

from rich.console import Console, Group
from rich.live import Live
from rich.panel import Panel
from rich.table import Table
from rich.text import Text

from daqsvc.detectors.rotor_bank.settings import ROTOR_BANK

if TYPE_CHECKING:
    from types import TracebackType
    from typing import Self

    from sim_hw.demo.page import PageAddress
    from sim_hw.demo.session import DemoSummary, Received, Script

LAST_ALARMS = 8
BAR = 28
PER_SECOND = 8
_MUCH_SLOWER = 1.2
COLUMNS = (
    ("rms", "RMS", None),
    ("peak", "peak", None),
    ("crest_factor", "crest", ""),
    ("velocity_rms", "velocity RMS", "mm/s"),
    ("gap_voltage", "gap", "V"),
)
"""Statistics that are shown if there are any, with title and unit; None for the sensor's own unit."""

COLOURS = {"normal": "green", "alert": "yellow", "danger": "red"}


class _PipeConsole(Console):
    """Reports when the output is no longer read; rich would exit at once and leave everything as it is."""

    def on_broken_pipe(self) -> None:
        self.quiet = True
        raise BrokenPipeError


class View:
    """Shows messages as they come: live in a terminal, else a line for each alarm.

    Args:
        script: what is played.
        speed: at which speed.
        console: where to.
    """

    def __init__(self, script: Script, speed: float, console: Console | None = None) -> None:
        self._script = script
        self._speed = speed
        self._console = console or _PipeConsole()
        self._levels: dict[str, dict[str, Any]] = {}
        self._bank: dict[str, Any] | None = None
        self._alarms: deque[tuple[int, dict[str, Any]]] = deque(maxlen=LAST_ALARMS)
        self._status: dict[str, Any] | None = None
        self._start_ns: int | None = None
        self._now_ns = 0
        self._live = Live(
            console=self._console, refresh_per_second=PER_SECOND, get_renderable=self.picture, transient=True
        )

    def __enter__(self) -> Self:
        self._console.print(Text(self._script.title, style="bold"))
        if self._console.is_terminal:
            self._console.print(Text("the first run compiles kernels, which may take minutes", style="dim"))
            self._live.start()
        return self

    def __exit__(
        self,
        exc_type: type[BaseException] | None,
        exc: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        if self._console.is_terminal:
            self._live.stop()
            if exc is None:
                self._console.print(self.picture())

    def show_page(self, address: PageAddress) -> None:
        """State where the page is."""
        self._console.print(f"in a browser: {address.look}", soft_wrap=True)
        self._console.print(f"  to handle its alarms, too: {address.act}", soft_wrap=True)

    def on_message(self, message: Received) -> None:
        """Take a message in."""
        payload = message.payload
        self._now_ns = max(self._now_ns, payload["monotonic_ns"])
        if message.kind == "diagnosis":
            if payload["detector"] == ROTOR_BANK:
                self._bank = payload
            else:
                self._levels[payload["detector"].removeprefix("levels/")] = payload
            if self._start_ns is None:
                played_s = payload["window"]["end_index"] / self._script.rate_hz
                self._start_ns = payload["monotonic_ns"] - round(1e9 * played_s)
        elif message.kind == "alarm":
            # When it was received: samples that show it end sooner, and windows of detectors differ.
            self._alarms.appendleft((self._now_ns, payload))
            if not self._console.is_terminal:
                self._console.print(self._alarm_line(self._now_ns, payload), soft_wrap=True)
        elif message.kind == "status":
            self._status = payload["figures"]

    def picture(self) -> Group:
        """The view as it is now."""
        parts: list[Any] = [Panel(self._channels(), title="channels", title_align="left")]
        if self._bank is not None:
            title = f"rotor: {self._bank['decision']}"
            if self._bank["revolutions"] is not None:
                title += f" at revolution {self._bank['revolutions']:.0f}"
            if others := [mode for mode in self._bank["group"] if mode != self._bank["decision"]]:
                title += f", not told apart from {', '.join(others)}"
            parts.append(Panel(self._modes(self._bank), title=title, title_align="left"))
        # The alarms come last, the newest first: a low terminal cuts off the oldest and nothing else.
        parts.append(Panel(self._health(), title="link and loop", title_align="left"))
        alarms = [self._alarm_line(*alarm) for alarm in self._alarms] or [Text("none yet", style="dim")]
        title = "alarms, as they came from the broker, newest first"
        parts.append(Panel(Group(*alarms), title=title, title_align="left"))
        return Group(*parts)

    def _seconds(self, t_ns: int) -> float:
        return 0.0 if self._start_ns is None else (t_ns - self._start_ns) / 1e9

    def _channels(self) -> Table:
        table = Table(box=None, pad_edge=False, expand=True)
        table.add_column("sensor")
        measured = {
            name
            for payload in self._levels.values()
            for name, value in payload["statistics"].items()
            if value is not None
        }
        shown = [column for column in COLUMNS if column[0] in measured]
        for _, title, _ in shown:
            table.add_column(title, justify="right", no_wrap=True)
        table.add_column("now", no_wrap=True)
        for sensor, payload in sorted(self._levels.items()):
            values = payload["statistics"]
            unit = payload.get("units", {}).get("rms", "")
            state = (
                payload["decision"] if payload["quality"] == "good" else payload["quality"].replace("_", " ")
            )
            colour = COLOURS.get(payload["decision"], "dim") if payload["quality"] == "good" else "magenta"
            table.add_row(
                sensor,
                *(_figure(values.get(name), unit if its is None else its) for name, _, its in shown),
                Text(state, style=colour),
            )
        if not self._levels:
            table.add_row(Text("waiting for the first window", style="dim"))
        return table

    def _modes(self, bank: dict[str, Any]) -> Table:
        table = Table.grid(padding=(0, 2))
        for mode, probability in bank["probabilities"].items():
            filled = round((probability or 0.0) * BAR)
            declared = mode == bank["decision"]
            colour = COLOURS[bank["severity"]] if declared else "blue"
            bar = Text("█" * filled, style=colour) + Text("░" * (BAR - filled), style="dim")
            table.add_row(
                Text(mode, style="bold" if declared else ""),
                bar,
                f"{probability or 0.0:6.3f}",
                Text("declared", style=f"bold {colour}") if declared else "",
            )
        return table

    def _alarm_line(self, heard_ns: int, alarm: dict[str, Any]) -> Text:
        at = f"{self._seconds(heard_ns):8.2f} s  "
        line = Text()
        line.append(at, style="dim")
        line.append(f"{alarm['level']:<7}", style=COLOURS[alarm["level"]])
        line.append(f" {alarm['kind']:<9} {alarm['message']}")
        return line

    def _health(self) -> Group:
        if self._status is None:
            return Group(Text("waiting for the first status", style="dim"))
        # Lines short enough for a narrow terminal, so that what is below them stays in sight.
        lines: list[Text] = []
        for name, stream in self._status["streams"].items():
            lost = stream["samples_lost"]
            lines.append(
                Text.assemble(
                    f"{name}: {stream['samples_received']:,} samples, ",
                    (f"{lost:,} lost", "red" if lost else "green"),
                    f", jitter {stream['jitter_ms']:.2f} ms",
                )
            )
            lines.append(
                Text(
                    f"frames: {stream['frames_duplicate']} twice, {stream['frames_reordered']} overtaken, "
                    f"{stream['frames_corrupt']} corrupt"
                )
            )
        played_s = min(self._seconds(self._now_ns), self._script.duration_s)
        lag = self._status["loop_lag_ms"]
        delivered = self._status["mqtt"].get("acknowledged", 0)
        waiting = self._status["outbox"]["depth"]
        lines.append(Text(f"event loop lag: p50 {lag['p50']:.2f} ms, p99 {lag['p99']:.2f} ms"))
        lines.append(Text(f"MQTT: {delivered:,} acknowledged, {waiting:,} waiting"))
        lines.append(Text(f"{played_s:.1f} of {self._script.duration_s:.1f} s, speed {self._speed:g}"))
        return Group(*lines)

    def show_summary(self, summary: DemoSummary, console: Console | None = None) -> None:
        """Print the summary, to another console if one is given."""
        console = console or self._console
        if summary["onsets"]:
            table = Table(title="what happened, and when it was reported", title_justify="left")
            for title in ("mode", "onset (rev)", "declared (rev)", "delay (rev)"):
                table.add_column(title, justify="left" if title == "mode" else "right")
            for row in summary["onsets"]:
                table.add_row(
                    row["mode"],
                    f"{row['onset_rev']:.2f}",
                    *(
                        ("never", "-")
                        if row["declared_rev"] is None
                        else (f"{row['declared_rev']:.2f}", f"{row['delay_rev']:.2f}")
                    ),
                )
            console.print(table)
            console.print(f"wrong declarations: {summary['wrong_declarations']}")
        samples, frames, lag = summary["samples"], summary["frames"], summary["loop_lag_ms"]
        console.print(
            f"samples: {samples['sent']:,} sent, {samples['received']:,} received, {samples['lost']:,} lost, "
            f"{samples['skipped_by_detectors']:,} skipped"
        )
        if left := samples["left_over"]:
            one = left == 1
            why = "it fills no frame" if one else "they fill no frame"
            if frames["not_sent"]:
                why = f"the scenario has {' and '.join(frames['not_sent'])}; the last may fill no frame"
            console.print(f"{left:,} {'sample was' if one else 'samples were'} not sent: {why}")
        if any(frames["injected"].values()):
            for what in ("injected", "counted"):
                counts = ", ".join(f"{count} {fault}" for fault, count in frames[what].items())
                console.print(f"link faults {what}: {counts}")
            beyond = frames["counted"]["dropped"] - frames["injected"].get("dropped", 0)
            if beyond > 0 and frames["not_sent"]:
                console.print(
                    f"{beyond} of the frames counted as dropped were never on the bus: the scenario has "
                    f"{' and '.join(frames['not_sent'])}"
                )
        console.print(
            f"event loop lag: p50 {lag['p50']:.2f} ms, p99 {lag['p99']:.2f} ms, max {lag['max']:.2f} ms"
        )
        played_s, took_s = summary["simulated_s"], summary["real_s"]
        console.print(
            f"{summary['alarm_events']} alarm events among {summary['messages']} messages "
            f"through the broker; {played_s:.1f} s played in {took_s:.1f} s, without the start"
        )
        wanted_s = played_s / self._speed if self._speed else 0.0
        if summary["complete"] and took_s > _MUCH_SLOWER * wanted_s > 0.0:
            console.print(
                f"That is {played_s / took_s:.2g} times the speed of the machine, and not {self._speed:g} "
                "times: this computer is too slow for more, or too busy."
            )

    def show_snapshots(self, summary: DemoSummary) -> None:
        """Print where the snapshots of alarms are, and what they are good for."""
        for path in summary["snapshots"]:
            self._console.print("snapshot of an alarm, to be judged again with:")
            # A line that can be copied, however long it is.
            self._console.print(f"daqsvc replay {shlex.quote(path)}", soft_wrap=True)
        if gone := summary["snapshots_gone"]:
            self._console.print(
                f"alarms left {'a snapshot' if gone == 1 else f'{gone} snapshots'}, which were removed "
                "with the demo: --snapshots DIR keeps them for daqsvc replay"
            )


def _figure(value: float | None, unit: str) -> str:
    return "" if value is None else f"{value:.3g} {unit}".rstrip()
