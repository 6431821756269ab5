"""Make docs/demo.svg, the picture in the README, from a run of the demo: ``python docs/make_picture.py``."""

from __future__ import annotations

import argparse
import asyncio
import io
import re
from pathlib import Path

from rich.console import Console

from daqsvc import kernel_cache
from sim_hw.demo.command import DemoCommand, script_of
from sim_hw.demo.session import DemoSession, summarise
from sim_hw.demo.view import View

WIDTH = 110
PICTURE = Path(__file__).with_name("demo.svg")


def drawn() -> str:
    """The last view and the summary of the paper's scenario, played in real time."""
    parser = argparse.ArgumentParser()
    DemoCommand().add_arguments(parser)
    arguments = parser.parse_args([])
    script = script_of(arguments)
    console = Console(record=True, width=WIDTH, file=io.StringIO())
    view = View(script, arguments.speed, Console(file=io.StringIO()))
    session = DemoSession(
        script, speed=arguments.speed, broker_url=arguments.broker, on_message=view.on_message
    )
    outcome = asyncio.run(session.run())
    console.print(view.picture())
    view.show_summary(summarise(script, outcome, speed=arguments.speed), console)
    svg = console.export_svg(title="make demo")
    # The fonts would be fetched from the web by whoever looks at it.
    return re.sub(r"@font-face \{.*?\}\s*", "", svg, flags=re.DOTALL)


if __name__ == "__main__":
    kernel_cache.prepare()
    PICTURE.write_text(drawn(), "utf-8")
