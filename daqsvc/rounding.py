"""Figures that people read: measured ones, and those in remedies, rounded to the side that is accepted."""

from __future__ import annotations

from decimal import ROUND_CEILING, ROUND_FLOOR, Context, Decimal

_NOISE = 1e-12
"""Relative error of a few floating-point operations: 0.30000000000000004 is 0.3, and not 0.301."""


def readable(value: float, digits: int = 4) -> str:
    """A measured value, rounded to so many digits: 65 540 rpm, and not 6.554e+04.

    Args:
        value: anything, finite or not.
        digits: significant ones, from 1.
    """
    return f"{float(f'{value:.{digits}g}'):.12g}"


def with_unit(value: float, unit: str, digits: int = 4) -> str:
    """A measured value and its unit; of a plain number, whose unit is ``"1"``, the value alone.

    Args:
        value: anything, finite or not.
        unit: as machine files write it; empty if there is none.
        digits: significant ones, from 1.
    """
    return f"{readable(value, digits)}{unit_behind(unit)}"


def unit_behind(unit: str) -> str:
    """What follows a value of this unit: a space and the unit, or nothing."""
    return f" {unit}" if unit not in {"", "1"} else ""


def counted(number: int, what: str) -> str:
    """A number of things: ``1 machine``, ``2 machines``, ``1,000 known faults``.

    Args:
        number: of them.
        what: one of them is called; its plural ends with an s.
    """
    return f"{number:,} {what}{'' if number == 1 else 's'}"


def counted_are(number: int, what: str) -> str:
    """The same with its verb: ``1 sample is``, ``2 samples are``."""
    return f"{counted(number, what)} {'is' if number == 1 else 'are'}"


def rounded_up(value: float, digits: int = 3) -> str:
    """The least figure of so many digits that is no less: for "or more".

    Args:
        value: bound, finite.
        digits: significant ones, from 1.
    """
    return _rounded(value, digits, ROUND_CEILING)


def rounded_down(value: float, digits: int = 3) -> str:
    """The largest figure of so many digits that is no more: for "or less".

    Args:
        value: bound, finite.
        digits: significant ones, from 1.
    """
    return _rounded(value, digits, ROUND_FLOOR)


def _rounded(value: float, digits: int, rounding: str) -> str:
    nearest = float(f"{value:.{digits}g}")
    if abs(nearest - value) > _NOISE * abs(value):
        nearest = float(Context(prec=digits, rounding=rounding).create_decimal(Decimal(value)))
    # 12 300 and not 1.23e+04: people read it.
    return f"{nearest:.15g}"
