"""Verbs that compute with compiled kernels, by a machine file."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from daqsvc.settings import MachineFile


class VerbWithKernels:
    """What such a verb is made of.

    Args:
        load: reads a machine file; None after its errors have been printed.
        prepare_kernel_cache: states where compiled kernels are kept.
    """

    def __init__(
        self, load: Callable[[Path], MachineFile | None], prepare_kernel_cache: Callable[[], None]
    ) -> None:
        self._load = load
        self._prepare_kernel_cache = prepare_kernel_cache
