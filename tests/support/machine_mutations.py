"""Machine files that nobody would write: the examples, spoilt in bytes, words or structure."""

from __future__ import annotations

import json
import random
import re
import tomllib
from typing import TYPE_CHECKING, Any

from support.machine_files import MACHINES

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

EXAMPLES = sorted(MACHINES.glob("*.toml"))
_TOKEN = re.compile(r'"[^"\n]*"|[A-Za-z0-9_.+-]+|[\[\]{}=,]|\n')
_WORDS = sorted({word for path in EXAMPLES for word in _TOKEN.findall(path.read_text(encoding="utf-8"))})
_VALUES: list[Any] = [
    *(0, 1, -1, 2, 7, 255, 256, 65_535, 65_536, 2**31, 2**53, 2**63 - 1, -(2**63)),
    *(0.0, -0.0, 5e-324, 1e-300, 1e-9, 1e-3, 0.5, 1.5, 1e3, 1e6, 1e9, 1e12, 1e38, 1e308, -1e308),
    *(
        float("inf"),
        float("nan"),
        True,
        False,
        "",
        "x",
        "~",
        "/",
        ".",
        "..",
        "a b",
        "\u202e",
        "\x00",
        "\n",
        "é" * 300,
    ),
    *("can", "modbus", "rotor-bank", "probe-x", "mqtts://h", "tcp://h:1", "/dev/null", "$HOME", "x.dbc"),
    *([], {}, [[]], [{}], {"": 1}, [0, 0], [1, 2, 3], [0.0, 1.0], ["x", "y"], {"byte": 0}),
]


def toml(value: Any) -> str:
    """A value as TOML, tables inline."""
    if isinstance(value, dict):
        pairs = (f"{json.dumps(key)} = {toml(item)}" for key, item in value.items())
        return "{" + ", ".join(pairs) + "}"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(map(toml, value)) + "]"
    if isinstance(value, bool | str):
        return json.dumps(value).replace("\\ud", "?").replace("\x7f", "?")
    return str(value)


def _bytes(rng: random.Random, path: Path) -> bytes:
    spoilt = bytearray(path.read_bytes())
    for _ in range(rng.randint(1, 8)):
        at = rng.randrange(len(spoilt))
        match rng.randrange(4):
            case 0:
                spoilt[at] ^= 1 << rng.randrange(8)
            case 1:
                spoilt[at] = rng.choice(b"\x00\x09\n\r \"#'=.[]{}09aeE_-+\x7f\x80\xff")
            case 2:
                del spoilt[at : at + rng.randint(1, 40)]
            case _:
                spoilt[at:at] = spoilt[at : at + rng.randint(1, 60)] * rng.randint(1, 3)
    return bytes(spoilt)


def _tokens(rng: random.Random, path: Path) -> bytes:
    # Without comments: a word spoilt in one would change nothing.
    text = re.sub(r"#[^\n]*", "", path.read_text(encoding="utf-8"))
    places = list(_TOKEN.finditer(text))
    for place in sorted(rng.sample(places, rng.randint(1, 4)), key=lambda one: -one.start()):
        word = rng.choice(["", rng.choice(_WORDS), toml(rng.choice(_VALUES)), place[0] * 2])
        text = text[: place.start()] + word + text[place.end() :]
    return text.encode()


def _structure(rng: random.Random, path: Path) -> bytes:
    document = tomllib.loads(path.read_text(encoding="utf-8"))
    for _ in range(rng.randint(1, 3)):
        tables = list(_containers(document))
        holder = rng.choice(tables)
        keys = list(holder) if isinstance(holder, dict) else list(range(len(holder)))
        if not keys:
            continue
        key = rng.choice(keys)
        old = holder[key]
        number = isinstance(old, int | float) and not isinstance(old, bool)
        match rng.randrange(6):
            case 0:
                holder[key] = rng.choice(_VALUES)
            case 1 if number:
                holder[key] = type(old)(old * rng.choice([0.1, 0.5, 0.9, 1.1, 2, 10, 1000, -1]))
            case 2:
                del holder[key]
            case 3 if isinstance(holder, list):
                holder.append(json.loads(json.dumps(old)))
            case 4 if isinstance(holder, dict):
                holder[rng.choice(_WORDS).strip('"')] = old
            case _:
                other = rng.choice(list(_containers(document)))
                values = list(other.values()) if isinstance(other, dict) else other
                if values:
                    holder[key] = json.loads(json.dumps(rng.choice(values)))
    return "".join(f"{json.dumps(key)} = {toml(value)}\n" for key, value in document.items()).encode()


def _numbers(rng: random.Random, path: Path) -> bytes:
    """Numbers that may be meant: most of these files can be used."""
    document = tomllib.loads(path.read_text(encoding="utf-8"))
    for _ in range(rng.randint(1, 4)):
        holders = [
            (holder, key)
            for holder in _containers(document)
            for key in (holder if isinstance(holder, dict) else range(len(holder)))
            if isinstance(holder[key], int | float) and not isinstance(holder[key], bool)
        ]
        holder, key = rng.choice(holders)
        scaled = holder[key] * rng.choice([0.01, 0.3, 0.8, 0.99, 1.01, 1.3, 3.0, 100.0])
        holder[key] = round(scaled) if isinstance(holder[key], int) else scaled
    return "".join(f"{json.dumps(key)} = {toml(value)}\n" for key, value in document.items()).encode()


def _containers(value: Any) -> Any:
    if isinstance(value, dict | list):
        yield value
        for item in value.values() if isinstance(value, dict) else value:
            yield from _containers(item)


MUTATIONS: tuple[Callable[[random.Random, Path], bytes], ...] = (_bytes, _tokens, _structure, _numbers)


def mutated(seed: int) -> tuple[Path, bytes]:
    """An example and what has become of it; the same for the same seed."""
    rng = random.Random(seed)
    path = EXAMPLES[seed % len(EXAMPLES)]
    return path, rng.choice(MUTATIONS)(rng, path)
