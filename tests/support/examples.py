"""How many examples a property test draws: a share of them every day, all in ``make test-long``."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, Any

import pytest

if TYPE_CHECKING:
    from _pytest.mark.structures import ParameterSet

ALL = os.environ.get("DAQSVC_EXAMPLES") == "all"
_FEW = 6
"""Counts up to this are not cut."""


def examples(count: int) -> int:
    """Examples for ``max_examples``, of the ``count`` that the property is tried with in ``make test-long``.

    They are drawn in the same order each time, so the short run is the beginning of the long one.
    """
    return count if ALL else max(min(count, _FEW), count // 3)


def first_of(first: object, *others: Any) -> list[object | ParameterSet]:
    """Cases for ``parametrize``: the first every day, all in ``make test-long``.

    Tuples are several arguments.
    """
    arguments = [one if isinstance(one, tuple) else (one,) for one in others]
    return [first, *(pytest.param(*several, marks=pytest.mark.long) for several in arguments)]
