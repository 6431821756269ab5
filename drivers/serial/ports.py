"""Serial ports of this computer, by names that stay."""

from __future__ import annotations

from pathlib import Path

BY_ID = Path("/dev/serial/by-id")


def serial_ports() -> list[str]:
    """Serial ports of this computer that were plugged in, by the names that stay."""
    try:
        return sorted(str(path) for path in BY_ID.iterdir())
    except OSError:
        return []


def lasting_name(port: str) -> str:
    """The name of a port that stays the same when it is plugged in again; its own where it has none."""
    for name in serial_ports():
        if Path(name).resolve() == Path(port).resolve():
            return name
    return str(Path(port).absolute())
