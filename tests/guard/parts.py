"""The parts of the guard that need no recordings: each makes texts, by the name of their golden file."""

from __future__ import annotations

import re
import time
from typing import TYPE_CHECKING

from guard.broken import Broken, contradictions, spoilt
from guard.messages import structure
from guard.recordings import recordings
from guard.usage import helps, wrong_lines, wrong_values
from guard.verbs import ROOT, answer, machine_files, workplace

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping
    from pathlib import Path

    from guard.verbs import Answer

_MEMORY = (
    (re.compile(r"this computer has \S+ GB"), "this computer has <memory> GB"),
    (re.compile(r"write ring_s = \S+ or less"), "write ring_s = <by memory> or less"),
)
"""How much memory there is, which `check` holds the rings against."""


def examples() -> dict[str, str]:
    """What `check` and `example` print of the examples and specimens."""
    with workplace() as folder:
        return {
            "check.txt": _joined(answer("check", name) for name in machine_files(folder)),
            "example.txt": _joined(
                [
                    answer("example"),
                    answer("example", "laval-rig"),
                    answer("example", "dbc-triaxial", "--out", "."),
                    answer("example", "dbc-triaxial", "--out", "."),
                    answer("check", "dbc-triaxial.toml"),
                ]
            ),
        }


def detectability() -> dict[str, str]:
    """What `detectability` prints of the examples and specimens."""
    with workplace() as folder:
        return {
            "detectability.txt": _joined(
                answer("detectability", name, *more)
                for name in machine_files(folder)
                for more in ((), ("--json",), ("--noise-um", "2", "--eccentricity-um", "10"))
            )
        }


def broken() -> dict[str, str]:
    """What `check` says of machine files that are wrong."""
    with workplace() as folder:
        texts = {
            path.name: path.read_text(encoding="utf-8")
            for path in sorted((folder / "machines").glob("*.toml"))
        }
        usable = {name: text for name, text in texts.items() if answer("check", f"machines/{name}").code == 0}
        # Those with a driver or a file that is not there are right but for that.
        usable |= {name: texts[name] for name in ("specimen-other.toml", "specimen-calibrated.toml")}
        return {
            "broken-tables.txt": "\n".join(_checked(folder, texts, case) for case in spoilt(usable)),
            "broken-together.txt": "\n".join(_checked(folder, texts, case) for case in contradictions(texts)),
            "broken-text.txt": "\n".join(_checked(folder, texts, case) for case in _not_toml(texts)),
        }


def _checked(folder: Path, texts: Mapping[str, str], case: Broken) -> str:
    file = folder / "machines" / case.machine
    file.write_bytes(case.text.encode("utf-8", "surrogateescape"))
    told = str(answer("check", f"machines/{case.machine}")).partition("\n")[2]
    file.write_text(texts[case.machine], encoding="utf-8")
    for pattern, instead in _MEMORY:
        told = pattern.sub(instead, told)
    return f"== {case.name} ({case.machine})\n{told}\n"


def _not_toml(texts: Mapping[str, str]) -> Iterable[Broken]:
    """Texts that are no TOML, or none that a person writes."""
    name = "laval-rig.toml"
    text = texts[name]
    where = text.index("[machine]")
    for title, addition in {
        "a key without a value": "key =\n",
        "a key without an equals sign": "key\n",
        "a quote that is not closed": 'key = "value\n',
        "a bracket that is not closed": "key = [1, 2\n",
        "a brace that is not closed": "key = { a = 1\n",
        "a header that is not closed": "[machine\n",
        "a word without quotes": "key = value\n",
        "a colon in place of the equals sign": "key: 1\n",
        "a decimal comma": "key = 1,5\n",
        "a leading zero": "key = 012\n",
        "a number with a unit": "key = 10 Hz\n",
        "a Python boolean": "key = True\n",
        "a backslash that escapes nothing": 'key = "C:\\daq"\n',
        "a table twice": "[mqtt]\n[mqtt]\n",
        "a key twice": 'site = "other"\n',
        "a table and a value of one name": "[site]\n",
        "an array in place of a table": "[[machine]]\n",
        "a tab in a name": "ke\ty = 1\n",
        "typographic quotes": "key = \u201cvalue\u201d\n",
        "a null byte": "key = 1\x00\n",
        "a byte that is not UTF-8": 'key = "K\udcf6ln"\n',
        "a number with hundreds of digits": f"key = {'9' * 500}\n",
        "infinity": "key = inf\n",
        "a date": "key = 2026-01-01\n",
    }.items():
        yield Broken(title, name, text[:where] + addition + text[where:])
    yield Broken("an empty file", name, "")
    yield Broken("blank lines", name, "\n\n")
    yield Broken("JSON", name, '{"schema_version": 1}\n')
    yield Broken("INI", name, "[machine]\nname: rig\n")
    yield Broken("another schema version", name, text.replace("schema_version = 1", "schema_version = 2"))
    yield Broken("cut off", name, text[: len(text) // 2])
    yield Broken("line ends of Windows", name, text.replace("\n", "\r\n").replace("fd = true", "fd = maybe"))
    yield Broken("a byte order mark", name, "\ufeff" + text.replace("fd = true", 'fd = "yes"'))


def schemas() -> dict[str, str]:
    """The published schemas of payloads in docs/schemas; test_mqtt_schemas.py holds the code to these."""
    files = sorted((ROOT / "docs" / "schemas").glob("daqsvc.*.json"))
    return {"schemas.txt": "".join(f"== {file.name}\n{file.read_text(encoding='utf-8')}" for file in files)}


def usage() -> dict[str, str]:
    """Help texts, and what is said of wrong command lines."""
    with workplace():
        return {
            "help.txt": _joined(helps()),
            "usage.txt": _joined(wrong_lines()),
            "usage-values.txt": "\n".join(wrong_values()) + "\n",
        }


def keys() -> dict[str, str]:
    """Topics and keys of what a service publishes."""
    with workplace():
        return {"messages.txt": structure()}


def _joined(answers: Iterable[Answer]) -> str:
    return "\n\n".join(str(one).rstrip() for one in answers) + "\n"


FAST: Mapping[str, Callable[[], dict[str, str]]] = {
    "keys": keys,
    "broken": broken,
    "detectability": detectability,
    "examples": examples,
    "usage": usage,
    "schemas": schemas,
}
"""Parts by name, what takes longest first."""


def run(name: str) -> tuple[str, dict[str, str], float]:
    """One part, or one group of recordings; its name, its texts, and how many seconds it took."""
    begun = time.monotonic()
    texts = FAST[name]() if name in FAST else recordings(name)
    return name, texts, time.monotonic() - begun
