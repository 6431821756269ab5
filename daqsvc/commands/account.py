"""``daqsvc account``: who may sign in to the page."""

from __future__ import annotations

import argparse
import getpass
import sys
from pathlib import Path

from daqsvc.commands.arguments import EXIT_OK
from daqsvc.commands.complaint import complain
from daqsvc.errors.command_line import NOT_KNOWN, WRONG_VALUE

LEAST_PASSWORD = 10


class AccountCommand:
    """``daqsvc account FILE NAME [--role ROLE | --remove]``."""

    help = "make, change or remove an account for the page"
    description = (
        "Make an account for daqsvc page --accounts FILE, change its password or role, or remove it. "
        "The password is asked for; if standard input is not a terminal, it is read from there. The "
        "file contains only its hash. A running page uses the changed file at once."
    )

    def add_arguments(self, parser: argparse.ArgumentParser) -> None:
        """See `daqsvc.cli.Command.add_arguments`."""
        parser.add_argument(
            "file", type=Path, metavar="FILE", help="file of accounts; it is made if it does not exist"
        )
        parser.add_argument("name", type=_name, metavar="NAME", help="name of the account")
        either = parser.add_mutually_exclusive_group()
        either.add_argument(
            "--role",
            choices=["viewer", "operator"],
            default="viewer",
            help="a viewer only sees the page, an operator also handles alarms (default: viewer)",
        )
        either.add_argument("--remove", action="store_true", help="remove the account")

    def run(self, arguments: argparse.Namespace) -> int:
        """See `daqsvc.cli.Command.run`."""
        from daqsvc.page.access.accounts import (  # noqa: PLC0415 - only what a verb needs
            LONGEST_PASSWORD,
            AccountsError,
            account_line,
            write_account,
        )
        from daqsvc.page.access.role import Role  # noqa: PLC0415

        file, name = arguments.file, arguments.name
        line = None
        if not arguments.remove:
            password = _password(name)
            if not LEAST_PASSWORD <= len(password) <= LONGEST_PASSWORD:
                lengths = f"{LEAST_PASSWORD} to {LONGEST_PASSWORD}"
                what = f"a password has {lengths} characters: choose another one"
                return complain("daqsvc account", what, WRONG_VALUE)
            line = account_line(name, Role(arguments.role), password)
        try:
            was_there = write_account(file, name, line)
        except AccountsError as error:
            return complain("daqsvc account", error, error.code)
        if arguments.remove and not was_there:
            return complain("daqsvc account", f"{file} has no account {name}", NOT_KNOWN)
        done = "is removed" if arguments.remove else f"may sign in as {arguments.role}"
        print(f"{name} {done}")  # noqa: T201 - for a person
        return EXIT_OK


def _password(name: str) -> str:
    """What a person types twice, or the first line of standard input."""
    if not sys.stdin.isatty():
        return sys.stdin.readline().rstrip("\r\n")
    while True:
        first = getpass.getpass(f"Password of {name}: ")
        if first == getpass.getpass("Once more: "):
            return first
        print("these are two passwords: type it again", file=sys.stderr)  # noqa: T201 - for a person


def _name(text: str) -> str:
    from daqsvc.page.access.accounts import NAME, NAME_IN_WORDS  # noqa: PLC0415 - only what a verb needs

    if NAME.fullmatch(text) is None:
        raise argparse.ArgumentTypeError(f"{text!r} is no name of an account: use {NAME_IN_WORDS}")
    return text
