"""Targets of a benchmark: one line for each, and a process that fails if one is missed."""

# ruff: noqa: T201 - printing is what it is for

from __future__ import annotations


class Targets:
    """What is asked of a benchmark, and whether it was met.

    Attributes:
        missed: names of the targets that were not met.
    """

    def __init__(self) -> None:
        self.missed: list[str] = []

    def ask(self, name: str, figure: str, ratio: float) -> None:
        """Say whether a target is met.

        Args:
            name: what is asked.
            figure: what was measured.
            ratio: of what was measured to what is asked, 1 or more if it is met.
        """
        met = ratio >= 1.0
        if not met:
            self.missed.append(name)
        print(
            f"target        {name}: {figure}, {ratio:.2f} times what is asked, {'met' if met else 'MISSED'}"
        )

    @property
    def exit_code(self) -> int:
        """0 if all were met, else 1."""
        return 1 if self.missed else 0
