"""``daqsvc example``: machine files and scenarios to start from; they come with the package."""

from __future__ import annotations

import os
import sys
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from daqsvc.commands.arguments import EXIT_OK, EXIT_USAGE
from daqsvc.commands.complaint import complain
from daqsvc.errors.command_line import ARGUMENTS, CANNOT_WRITE, NOT_KNOWN, THERE_ALREADY

if TYPE_CHECKING:
    import argparse
    from importlib.resources.abc import Traversable


_FOLDERS = {"machines": "machine files", "scenarios": "scenarios for daqsvc sim"}
_DEVICES = "../devices/"


class Example(NamedTuple):
    """A file that comes with the package.

    Attributes:
        name: its name without ending.
        folder: what it is, as a folder of ``config/``.
        text: its content.
    """

    name: str
    folder: str
    text: str

    @property
    def about(self) -> str:
        """The first sentence of the comment that it begins with."""
        lines = []
        for line in self.text.splitlines():
            if not line.startswith("# "):
                break
            lines.append(line.removeprefix("# "))
        return " ".join(lines).split(". ")[0].split(": ")[0].rstrip(".")

    @property
    def devices(self) -> list[str]:
        """Names of the DBC files that it needs."""
        devices = [
            line.split(_DEVICES)[1].split('"')[0] for line in self.text.splitlines() if _DEVICES in line
        ]
        return [name for name in devices if name.endswith(".dbc")]


def _root() -> Traversable:
    return resources.files("daqsvc") / "examples"


def examples() -> dict[str, Example]:
    """Every example by name, machine files first."""
    by_name: dict[str, Example] = {}
    for folder in _FOLDERS:
        for file in sorted((_root() / folder).iterdir(), key=lambda one: one.name):
            name = file.name.removesuffix(".toml")
            by_name[name] = Example(name, folder, file.read_text(encoding="utf-8"))
    return by_name


class ExampleCommand:
    """``daqsvc example [NAME] [--out PATH]``."""

    help = "list, print or copy machine files to start from"
    description = (
        "List the examples that come with daqsvc, print one, or copy one with the DBC files that it "
        "needs: daqsvc example laval-rig --out machine.toml"
    )

    def add_arguments(self, parser: argparse.ArgumentParser) -> None:
        """See `daqsvc.cli.Command.add_arguments`."""
        parser.add_argument("name", nargs="?", metavar="NAME", help="name of the example (default: list all)")
        parser.add_argument(
            "--out", type=Path, metavar="PATH", help="file or directory to copy it to (default: print it)"
        )

    def run(self, arguments: argparse.Namespace) -> int:
        """See `daqsvc.cli.Command.run`."""
        known = examples()
        if arguments.name is None and arguments.out is not None:
            words = "which one is to be written? name it before --out; daqsvc example lists them"
            return complain("daqsvc example", words, ARGUMENTS, EXIT_USAGE)
        if arguments.name is None:
            for folder, what in _FOLDERS.items():
                print(f"{what[0].upper()}{what[1:]}")  # noqa: T201 - this is what the verb is for
                for example in known.values():
                    if example.folder == folder:
                        print(f"  {example.name:<30}{example.about}")  # noqa: T201
            return EXIT_OK
        name = arguments.name.removesuffix(".toml")
        if name not in known:
            # Only here: with the settings comes most of what a start of any verb would take.
            from daqsvc.settings.problems import choice  # noqa: PLC0415

            words = f"there is no {name!r}; {choice(name, known)}"
            return complain("daqsvc example", words, NOT_KNOWN, EXIT_USAGE)
        if arguments.out is None:
            sys.stdout.write(known[name].text)
            return EXIT_OK
        return _copy(known[name], arguments.out)


def _copy(example: Example, out: Path) -> int:
    """Write an example, and beside it the DBC files that it names; all, or none if one is in the way."""
    target = out / f"{example.name}.toml" if out.is_dir() else out
    files = {target: example.text.replace(f'"{_DEVICES}', '"')}
    path = target
    try:
        for device in example.devices:
            path = target.parent / device
            content = (_root() / "devices" / device).read_text(encoding="utf-8")
            # Another example may have brought the same file.
            if not path.exists() or path.read_bytes() != content.encode():
                files[path] = content
        if in_the_way := [path for path in files if os.path.lexists(path)]:
            return _is_there(in_the_way[0])
        for path, text in files.items():
            with path.open("x", encoding="utf-8") as file:
                file.write(text)
            print(path)  # noqa: T201 - states what was written
    except FileExistsError:
        return _is_there(path)
    except OSError as error:
        return complain("daqsvc example", f"{path} cannot be written: {error.strerror}", CANNOT_WRITE)
    return EXIT_OK


def _is_there(path: Path) -> int:
    return complain("daqsvc example", f"{path} is there already; give another name", THERE_ALREADY)
