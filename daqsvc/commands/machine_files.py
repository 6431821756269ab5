"""What a verb is given as machine files: one, several, or a directory of them."""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING

from daqsvc.errors.code import coded
from daqsvc.errors.machine_file import NO_MACHINE_FILE

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

    from daqsvc.box import Box
    from daqsvc.settings import MachineFile, Problem

    Load = Callable[[Path], MachineFile | None]
    """Reads a machine file; None after its errors have been printed."""

log = logging.getLogger(__name__)


def load_box(paths: Sequence[Path], load: Load) -> Box | None:
    """The box of a machine file, or of several, or of all ``*.toml`` of a directory that are not hidden.

    Args:
        paths: as they were given; a directory represents several machines, also if it holds one file only,
            and ``plant.toml`` for the directory ``plant`` where there is no such file.
        load: reads a machine file.

    Returns:
        The box; None after all errors have been printed.
    """
    return load_machines(paths, load)[0]


def load_machines(paths: Sequence[Path], load: Load) -> tuple[Box | None, list[MachineFile]]:
    """The same, and the files that are sound each by itself, also where there is no box of them."""
    from daqsvc.settings import MachineFileError  # noqa: PLC0415 - each verb imports only what it needs

    machines: list[MachineFile] = []
    try:
        read = [load(file) for file in _files(paths)]
        machines += [machine for machine in read if machine is not None]
        return _box(paths, machines) if len(machines) == len(read) else None, machines
    except MachineFileError as error:
        for problem in error.problems:
            log.error("%s", problem, extra=coded(problem.code))  # noqa: TRY400 - the message is enough
        return None, machines


def read_box(paths: Sequence[Path]) -> Box:
    """The same, with all errors of all files in one exception.

    Raises:
        MachineFileError: the files cannot be used.
    """
    from daqsvc.settings import MachineFileError, load_machine_file  # noqa: PLC0415 - as above

    problems: list[Problem] = []
    machines: list[MachineFile] = []
    for file in _files(paths):
        try:
            machines.append(load_machine_file(file))
        except MachineFileError as error:
            problems += error.problems
    if problems:
        raise MachineFileError(problems)
    return _box(paths, machines)


def _files(paths: Sequence[Path]) -> list[Path]:
    """The files that are meant.

    Raises:
        MachineFileError: a directory has none.
    """
    from daqsvc.settings import MachineFileError, Problem  # noqa: PLC0415 - as above

    files: list[Path] = []
    for named in paths:
        # So the unit of systemd, which names a file, runs a directory of the same name as well.
        path = named.with_suffix("") if not named.exists() and named.with_suffix("").is_dir() else named
        # Names that begin with a dot are those of editors and of copies under way, such as `.#pump.toml`.
        inside = sorted(path.glob("[!.]*.toml")) if path.is_dir() else [path]
        if not inside:
            words = "no machine file (*.toml) is in this directory"
            remedy = "copy an example into it: daqsvc example"
            raise MachineFileError([Problem(path, None, "", "", words, remedy, NO_MACHINE_FILE)])
        files += inside
    return list(dict.fromkeys(files))


def _box(paths: Sequence[Path], machines: Sequence[MachineFile]) -> Box:
    from daqsvc.box import Box  # noqa: PLC0415 - as above

    alone = len(machines) == 1 and machines[0].path == paths[0]
    return Box.single(machines[0]) if alone else Box.several(machines)
