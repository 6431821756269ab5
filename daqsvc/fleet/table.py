"""The columns of the results, and the row of a recording: what `analyze` found, and what it is about."""

from __future__ import annotations

import json
import re
from datetime import UTC, datetime, timedelta
from functools import cache
from typing import TYPE_CHECKING, Any, TypeAlias

if TYPE_CHECKING:
    from collections.abc import Mapping

    from daqsvc.fleet.archive import ArchivedRecording

Row: TypeAlias = "dict[str, Any]"

_TYPES = {
    "machine": "string",
    "file": "string",
    "recorded": "time",
    "size_bytes": "int",
    "stamp": "string",
    "digest": "string",
    "machine_digest": "string",
    "version": "string",
    "judged": "bool",
    "reason": "string",
    "verdict": "string",
    "group": "strings",
    "named": "bool",
    "probability": "float",
    "severity": "float",
    "channel": "string",
    "alarms": "int",
    "onset_s": "float",
    "departure_s": "float",
    "bearing_verdict": "string",
    "bearing_group": "strings",
    "bearing_probability": "float",
    "bearing_reason": "string",
    "worst_detector": "string",
    "worst_severity": "string",
    "speed_rpm": "float",
    "revolutions": "int",
    "samples": "int",
    "missing": "int",
    "infinite": "int",
    "clipped": "int",
    "problems": "strings",
    "analysis": "string",
}
COLUMNS = tuple(_TYPES)
KEYS = ("file", "size_bytes", "stamp", "digest", "machine_digest", "version", "judged")
"""Columns by which what is judged is known again."""
_DATE = r"(?<!\d)((?:19|20)\d\d)-?(0[1-9]|1[0-2])-?(0[1-9]|[12]\d|3[01])"
_CLOCK = r"(?:[T_ -]?([01]\d|2[0-3])[:.-]?([0-5]\d)(?:[:.-]?([0-5]\d))?)?(?!\d)"
_TIME_IN_NAME = re.compile(_DATE + _CLOCK)
_SEVERITIES = ("normal", "alert", "danger")


@cache
def schema() -> Any:
    """Of the Parquet files."""
    import pyarrow as pa  # noqa: PLC0415 - of the extra

    kinds = {
        "string": pa.string(),
        "strings": pa.list_(pa.string()),
        "time": pa.timestamp("us", "UTC"),
        "int": pa.int64(),
        "float": pa.float64(),
        "bool": pa.bool_(),
    }
    return pa.schema([(name, kinds[kind]) for name, kind in _TYPES.items()])


def recorded_at(file: str) -> datetime | None:
    """When a recording was made, by the last date in its name (and a clock behind it); UTC.

    Args:
        file: path, e.g. ``2026/2026-11-23T1845.npz`` or ``pump_20261123_184500.csv``.
    """
    for year, month, day, hour, minute, second in reversed(_TIME_IN_NAME.findall(file)):
        try:
            return datetime(
                int(year),
                int(month),
                int(day),
                int(hour or 0),
                int(minute or 0),
                int(second or 0),
                tzinfo=UTC,
            )
        except ValueError:  # the 31st of a shorter month
            continue
    return None


def bound_at(text: str) -> tuple[datetime, datetime] | None:
    """The first and the last instant of a time that somebody wrote: of a day without a clock, all of it; UTC.

    Args:
        text: a time and nothing else, e.g. ``2026-03-08`` or ``2026-03-08T10:00``; None comes of any other.
    """
    text = text.removesuffix("Z").removesuffix("+00:00")
    match, begin = _TIME_IN_NAME.fullmatch(text), recorded_at(text)
    if match is None or begin is None:
        return None
    return begin, begin if match[4] else begin + timedelta(days=1) - timedelta(microseconds=1)


def begun_row(machine: str, machine_digest: str, version: str, recording: ArchivedRecording) -> Row:
    """The row of a recording that nothing is known of yet but where it lies."""
    return {
        **dict.fromkeys(COLUMNS),
        "machine": machine,
        "file": recording.file,
        "recorded": recorded_at(recording.file),
        "size_bytes": recording.size_bytes,
        "stamp": recording.stamp,
        "machine_digest": machine_digest,
        "version": version,
        "judged": False,
    }


def add_analysis(row: Row, analysis: Mapping[str, Any]) -> None:
    """Fill in what was found.

    Args:
        row: of the recording.
        analysis: the JSON object of ``daqsvc analyze --json``.
    """
    quality = analysis["data_quality"]
    row.update(
        judged=analysis["refused"] is None,
        reason=analysis["refused"],
        verdict=analysis["verdict"],
        group=list(analysis["group"]),
        named=analysis.get("named"),
        probability=_probability(analysis),
        severity=_number(analysis.get("severity")),
        channel=analysis.get("channel"),
        alarms=len(analysis.get("alarms", ())),
        onset_s=_seconds(analysis.get("onset")),
        departure_s=_seconds(analysis.get("departure")),
        speed_rpm=_number(analysis.get("speed_rpm")),
        revolutions=_whole(analysis.get("revolutions")),
        samples=_whole(quality.get("samples")),
        problems=list(quality["problems"]),
        analysis=json.dumps(analysis, ensure_ascii=False, allow_nan=False, separators=(",", ":")),
    )
    for what in ("missing", "infinite", "clipped"):
        row[what] = sum((quality.get(what) or {}).values())
    bearing = analysis.get("bearing")
    if isinstance(bearing, dict):
        row.update(
            bearing_verdict=bearing["verdict"],
            bearing_group=list(bearing["group"]),
            bearing_probability=_probability(bearing),
            bearing_reason=bearing["refused"],
        )
    row["worst_detector"], row["worst_severity"] = _worst(analysis.get("detectors") or {})


def _probability(analysis: Mapping[str, Any]) -> float | None:
    return _number(analysis.get("probabilities", {}).get(analysis["verdict"]))


def _worst(detectors: Mapping[str, Any]) -> tuple[str | None, str | None]:
    """The detector with the most severe statement, the first of those that are equally so."""
    ranked = [
        (_SEVERITIES.index(severity), name)
        for name, one in detectors.items()
        if (severity := (one.get("worst") or {}).get("severity")) in _SEVERITIES
    ]
    if not ranked:
        return None, None
    rank = max(rank for rank, _ in ranked)
    return next(name for at, name in ranked if at == rank), _SEVERITIES[rank]


def _seconds(instant: Mapping[str, Any] | None) -> float | None:
    return None if instant is None else _number(instant["seconds"])


def _number(value: Any) -> float | None:
    return float(value) if isinstance(value, int | float) else None


def _whole(value: Any) -> int | None:
    return int(value) if isinstance(value, int | float) else None
