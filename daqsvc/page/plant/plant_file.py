"""The file that states over which broker the boxes of a plant are heard: a table ``[mqtt]``, as theirs."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pydantic import ValidationError

from daqsvc.errors.command_line import CANNOT_READ
from daqsvc.publish.mqtt.settings import FILES, Mqtt
from daqsvc.settings.files import UnreadableFileError, read_bounded
from daqsvc.settings.toml_text import MOST_BYTES, TomlTextError, decoded, parse

if TYPE_CHECKING:
    from pathlib import Path

    from pydantic_core import ErrorDetails

OTHERS = {"commands", "home_assistant", "sparkplug", "live", "telemetry_expiry_s"}
"""What the table states about a box may be there, so that a machine file will do; it is not examined."""


class PlantFileError(Exception):
    """A plant file that cannot be used; the text names it and the remedy."""

    code = CANNOT_READ


def read_plant_file(path: Path) -> Mqtt:
    """The broker that a plant file names; blocks.

    Args:
        path: TOML with a table ``[mqtt]``; paths in it count from where it stands.

    Raises:
        PlantFileError: it cannot be used.
    """
    try:
        document, _ = parse(decoded(read_bounded(path, MOST_BYTES), path))
    except (UnreadableFileError, TomlTextError) as error:
        raise PlantFileError(f"{path}: {error}. Remedy: {error.remedy}") from None
    table = document.get("mqtt")
    if not isinstance(table, dict):
        raise PlantFileError(
            f"{path} has no table [mqtt]. Remedy: write [mqtt] into it, and below it "
            'url = "mqtts://broker.example:8883"'
        )
    try:
        mqtt = Mqtt.model_validate({key: one for key, one in table.items() if key not in OTHERS})
    except ValidationError as error:
        faults = "; ".join(_in_words(fault) for fault in error.errors(include_url=False, include_input=False))
        raise PlantFileError(f"{path}: {faults}") from None
    if not mqtt.tls and not mqtt.insecure:
        raise PlantFileError(
            f"{path}: mqtt.url is without TLS, so that passwords and alarms can be read and changed on the "
            "way. Remedy: use mqtts://, or write insecure = true if you accept that"
        )
    files = {key: getattr(mqtt, key) for key in FILES}
    return mqtt.model_copy(update={key: path.parent / one for key, one in files.items() if one is not None})


def _in_words(fault: ErrorDetails) -> str:
    where = ".".join(["mqtt", *map(str, fault["loc"])])
    what = "there is no such key" if fault["type"] == "extra_forbidden" else fault["msg"]
    remedy = fault.get("ctx", {}).get("remedy")
    return f"{where}: {what}" + (f". Remedy: {remedy}" if remedy else "")
