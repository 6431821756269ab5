"""The page of all verbs of the command line and their options, from the parsers."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from daqsvc.cli import commands, parser
from daqsvc.reference import formats
from daqsvc.reference.markdown import anchored, code, page, table

if TYPE_CHECKING:
    from collections.abc import Iterator


def parsers() -> Iterator[tuple[argparse.ArgumentParser, str]]:
    """The parser of ``daqsvc``, of each verb, and of each verb below one, with its line in the list."""
    root = parser(commands())
    yield root, root.description or ""
    yield from _below(root)


def _below(above: argparse.ArgumentParser) -> Iterator[tuple[argparse.ArgumentParser, str]]:
    for action in above._actions:  # noqa: SLF001 - argparse has no other way to look at a parser
        if isinstance(action, argparse._SubParsersAction):  # noqa: SLF001
            helps = {choice.dest: choice.help or "" for choice in action._choices_actions}  # noqa: SLF001
            for name, verb in action.choices.items():
                yield verb, helps.get(name, "")
                yield from _below(verb)


def options(verb: argparse.ArgumentParser) -> Iterator[tuple[str, argparse.Action]]:
    """The title of its group and each argument of a verb, but for ``--help`` and those that are not shown."""
    for group in verb._action_groups:  # noqa: SLF001
        for action in group._group_actions:  # noqa: SLF001
            hidden = isinstance(action, argparse._HelpAction | argparse._SubParsersAction)  # noqa: SLF001
            if not hidden and action.help != argparse.SUPPRESS:
                yield group.title or "", action


def gaps() -> Iterator[str]:
    """Verbs without a line in the list, or a description; options without help."""
    for verb, line in parsers():
        if not line:
            yield f"{verb.prog} has no line in the list of verbs: its help"
        if not verb.description:
            yield f"{verb.prog} has no description"
        for _, action in options(verb):
            if not action.help:
                yield f"{verb.prog} {_name(action)} has no help"
            if "--json" in action.option_strings and not formats.printed(verb.prog):
                yield f"{verb.prog} --json prints what is described nowhere: daqsvc.reference.formats"


def pages() -> dict[str, str]:
    """Text of each page, by file name."""
    listed, parts = [], []
    for verb, line in parsers():
        anchor = verb.prog.replace(" ", "-")
        listed.append((f"[`{verb.prog}`](#{anchor})", line))
        parts.append(anchored(f"## `{verb.prog}`", anchor))
        parts.append(f"```\n{_usage(verb)}\n```")
        parts.append(f"{' '.join((verb.description or '').split())}")
        groups: dict[str, list[tuple[str, ...]]] = {}
        for titled, action in options(verb):
            mark = f'<a id="{anchor}{action.option_strings[-1]}"></a>' if action.option_strings else ""
            name = f"{mark}{code(_name(action))}"
            help_text = _help(verb, action)
            if action.option_strings and (printed := formats.printed(verb.prog, action.option_strings[-1])):
                help_text += f": {', '.join(map(formats.link, printed))}"
            title = "arguments" if titled == "positional arguments" else titled
            groups.setdefault(title, []).append((name, help_text, _default(action)))
        parts += [
            f"{title[:1].upper()}{title[1:]}:\n\n{table(('argument', 'what it does', 'default'), rows)}"
            for title, rows in groups.items()
        ]
    return {"verbs.md": page("Verbs and options", _ABOUT, table(("verb", "what it does"), listed), *parts)}


def _usage(verb: argparse.ArgumentParser) -> str:
    files = [_name(action) for _, action in options(verb) if not action.option_strings]
    below = [
        "VERB" if action.metavar == "VERB" else "{" + ",".join(action.choices) + "}"
        for action in verb._actions  # noqa: SLF001
        if isinstance(action, argparse._SubParsersAction)  # noqa: SLF001
    ]
    return " ".join([verb.prog, "[options]", *below, *files])


def _name(action: argparse.Action) -> str:
    """How it is typed, e.g. ``-v, --verbose`` or ``--noise-um N``."""
    metavar = action.metavar if isinstance(action.metavar, str) else " ".join(action.metavar or ())
    value = metavar or (
        "{" + ",".join(map(str, action.choices)) + "}" if action.choices else action.dest.upper()
    )
    if not action.option_strings:
        return {"*": f"[{value} ...]", "+": f"{value} ...", "?": f"[{value}]"}.get(f"{action.nargs}", value)
    names = ", ".join(action.option_strings)
    if action.nargs == 0:
        return names
    return f"{names} {value}" + {"*": " ...", "+": " ..."}.get(f"{action.nargs}", "")


def _help(verb: argparse.ArgumentParser, action: argparse.Action) -> str:
    fields = {**vars(action), "prog": verb.prog}
    return " ".join(((action.help or "") % fields).split())


def _default(action: argparse.Action) -> str:
    default = action.default
    if default in (None, False, argparse.SUPPRESS) or default == [] or "default" in (action.help or ""):
        return ""
    return code(f"{default}")


_ABOUT = """Every verb of `daqsvc` with its arguments, as `daqsvc VERB --help` shows them. `daqsvc-sim` is
`daqsvc sim`. Exit codes, signals and environment variables are in [process.md](process.md)."""
