"""``daqsvc status``: the state of all parts, as the running service reports it."""

from __future__ import annotations

import json
import os
import shutil
import signal
import sys
import time
from functools import partial
from typing import TYPE_CHECKING, Any

from daqsvc.commands.arguments import EXIT_OK, EXIT_USAGE, signals_to_end
from daqsvc.commands.complaint import complain
from daqsvc.commands.store_argument import BadFileError, StoreNotFoundError, add_store, chosen_store
from daqsvc.errors.code import with_code
from daqsvc.errors.command_line import NO_SERVICE
from daqsvc.errors.service import UNUSABLE_STORE
from daqsvc.rounding import counted

if TYPE_CHECKING:
    import argparse

    from daqsvc.commands.machine_files import Load
    from daqsvc.commands.store_argument import ChosenStore

EVERY_S = 1.0
ENTER, LEAVE = "\x1b[?1049h\x1b[?25l", "\x1b[?25h\x1b[?1049l"
"""To the terminal's other screen without a cursor, and back (xterm's controls)."""
HOME, END_OF_LINE, END_OF_SCREEN = "\x1b[H", "\x1b[K", "\x1b[J"
"""To the upper left corner; clear what an earlier picture has left in a line, and below the last one."""


class StatusCommand:
    """``daqsvc status [FILE | --store DIR]``.

    Args:
        load: reads a machine file; None after its errors have been printed.
    """

    help = "show the state of sensors, buses, alarms, outbox and broker, from the running service"
    description = (
        "Show the present values of every channel and measure, whether sensors are OK, rates, losses by "
        "cause, alarms, outbox and broker, as the running service knows them. Exit code 1 if no service "
        "runs, or it may not be asked. Without a service, daqsvc alarms still shows the alarms."
    )

    def __init__(self, load: Load) -> None:
        self._load = load

    def add_arguments(self, parser: argparse.ArgumentParser) -> None:
        """See `daqsvc.cli.Command.add_arguments`."""
        parser.add_argument("--json", action="store_true", help="print one JSON object instead of text")
        parser.add_argument(
            "--watch",
            action="store_true",
            help="print it every second until Ctrl-C, also while the service restarts; with --json one "
            "object per line",
        )
        add_store(parser)

    def run(self, arguments: argparse.Namespace) -> int:
        """See `daqsvc.cli.Command.run`."""
        from daqsvc.control import ControlError, ask_status  # noqa: PLC0415 - only what a verb needs

        try:
            chosen = chosen_store(arguments, self._load)
            if arguments.watch:
                _watch(chosen, as_json=arguments.json)
            else:
                status = ask_status(chosen.directory, chosen.machine)
                chosen.tell_other("daqsvc status")
                print(_shown(status, as_json=arguments.json))  # noqa: T201 - what the verb is for
        except BadFileError:
            return EXIT_USAGE
        except (StoreNotFoundError, ControlError) as error:
            return complain("daqsvc status", error, error.code)
        return EXIT_OK


def _shown(machines: list[dict[str, Any]], *, as_json: bool, is_live: bool = False, warning: str = "") -> str:
    from daqsvc.commands.status_text import status_text  # noqa: PLC0415 - as above
    from daqsvc.commands.tables import wrapped  # noqa: PLC0415

    if as_json:
        return "\n".join(json.dumps(status) for status in machines)
    width = shutil.get_terminal_size().columns
    above = ["\n".join(wrapped(warning, width))] * bool(warning)
    return "\n\n".join([*above, *(status_text(one, width, alarms_first=is_live) for one in machines)])


def _watch(chosen: ChosenStore, *, as_json: bool) -> None:
    """Show the status again and again, until Ctrl-C.

    Raises:
        ControlError: there is no service at first, or it may not be asked.
    """
    from daqsvc.control import AbsentError, ask_status  # noqa: PLC0415 - as above

    is_live = not as_json and sys.stdout.isatty() and os.environ.get("TERM") != "dumb"
    picture = _Picture(is_live=is_live)
    before = {number: signal.signal(number, signal.default_int_handler) for number in signals_to_end()}
    # The picture covers what was printed before it.
    warning = with_code(f"{chosen.other}. Remedy: {chosen.instead}", UNUSABLE_STORE)
    shown_now = partial(
        _shown, as_json=as_json, is_live=is_live, warning=warning if chosen.other and is_live else ""
    )
    try:
        shown = shown_now(ask_status(chosen.directory, chosen.machine))
        if not is_live:
            chosen.tell_other("daqsvc status")
        with picture:
            picture.show(shown)
            while True:
                time.sleep(EVERY_S)
                try:
                    shown = shown_now(ask_status(chosen.directory, chosen.machine))
                except AbsentError as error:
                    picture.wait(f"{error}; it is asked again every second", shown)
                else:
                    picture.show(shown)
    except KeyboardInterrupt:
        pass  # that is how a person ends it
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


class _Picture:
    """What is shown: drawn over itself in a terminal, else one after the other.

    Args:
        is_live: whether it is drawn over itself.
    """

    def __init__(self, *, is_live: bool) -> None:
        self._is_live = is_live
        self._waits = False

    def __enter__(self) -> None:
        if self._is_live:
            _write(ENTER)

    def __exit__(self, *_: object) -> None:
        if self._is_live:
            _write(LEAVE)

    def show(self, text: str) -> None:
        """Show the state of everything."""
        self._waits = False
        if self._is_live:
            self._draw(text)
        else:
            _write(f"{text}\n" if text.startswith("{") else f"{text}\n\n")

    def wait(self, why: str, last: str) -> None:
        """Show why nothing is known by now, and the last state."""
        if self._is_live:
            from daqsvc.commands.tables import harmless, wrapped  # noqa: PLC0415 - as above

            lines = wrapped(harmless(why), shutil.get_terminal_size().columns)
            self._draw("\n".join([*lines, "", "The last state:", last]))
        elif not self._waits:
            complain("daqsvc status", why, NO_SERVICE)
        self._waits = True

    def _draw(self, text: str) -> None:
        """In one go, and over what is there, so that nothing flickers."""
        size = shutil.get_terminal_size()
        lines = [line[: size.columns] for line in text.splitlines()]
        if len(lines) > size.lines:
            hidden = len(lines) - size.lines + 1
            lines[size.lines - 1 :] = [
                f"... and {counted(hidden, 'more line')}: daqsvc status shows all"[: size.columns]
            ]
        body = f"{END_OF_LINE}\n".join(lines)
        _write(f"{HOME}{body}{END_OF_LINE}{END_OF_SCREEN}")


def _write(text: str) -> None:
    sys.stdout.write(text)
    sys.stdout.flush()
