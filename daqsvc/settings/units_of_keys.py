"""The unit of a key: the end of its name states it, or a mark on its type where the name cannot."""

from __future__ import annotations

from typing import TYPE_CHECKING

from daqsvc.settings.section import Unit

if TYPE_CHECKING:
    from pydantic.fields import FieldInfo

_UNITS = {
    "_n_s_per_m": "N s/m",
    "_n_per_m": "N/m",
    "_kb_per_s": "kB/s",
    "_mv_per_unit": "mV per unit",
    "_per_1000_rev": "per 1000 revolutions",
    "_per_s": "unit of the signal, per second",
    "_revolutions": "revolutions",
    "_percent": "%",
    "_bytes": "bytes",
    "_hours": "h",
    "_days": "days",
    "_nats": "nats",
    "_rpm": "rpm",
    "_deg": "deg",
    "_mb": "MB",
    "_gb": "GB",
    "_kg": "kg",
    "_hz": "Hz",
    "_um": "um",
    "_mm": "mm",
    "_db": "dB",
    "_ms": "ms",
    "_us": "us",
    "_v": "V",
    "_s": "s",
}
_WHOLE = {"baud": "bit/s", "bitrate": "bit/s", "data_bitrate": "bit/s"}


def unit_of_key(name: str, field: FieldInfo) -> str | None:
    """The unit of a key's value, e.g. ``ms`` of ``reorder_window_ms``; None if nothing states one.

    Args:
        name: the key.
        field: as the model declares it.
    """
    if marked := next((mark.name for mark in field.metadata if isinstance(mark, Unit)), None):
        return marked
    if name in _WHOLE:
        return _WHOLE[name]
    return next((unit for end, unit in _UNITS.items() if name.endswith(end)), None)
