"""A check against JSON Schema (2020-12), of the keywords that the published schemas use and no others."""

from __future__ import annotations

import re

_TYPES = {
    "object": dict,
    "array": list,
    "string": str,
    "boolean": bool,
    "null": type(None),
}
_NOTES = {"title", "description", "default", "examples", "format", "$schema", "$id", "$defs"}


def faults(value, schema, root=None, at="payload"):
    """What of ``value`` the schema does not allow, in words; an unknown keyword is an error of the test."""
    root = root or schema
    if "$ref" in schema:
        yield from faults(value, root["$defs"][schema["$ref"].removeprefix("#/$defs/")], root, at)
    for keyword, wanted in schema.items():
        if keyword == "$ref" or keyword in _NOTES:
            continue
        yield from _KEYWORDS[keyword](value, wanted, schema, root, at)


def _type(value, wanted, _schema, _root, at):
    if wanted in {"number", "integer"}:
        whole = isinstance(value, int) or (isinstance(value, float) and value.is_integer())
        fits = not isinstance(value, bool) and (
            whole if wanted == "integer" else isinstance(value, int | float)
        )
    else:
        fits = isinstance(value, _TYPES[wanted])
    if not fits:
        yield f"{at} is no {wanted}: {value!r}"


def _any_of(value, wanted, _schema, root, at):
    tried = [list(faults(value, one, root, at)) for one in wanted]
    if all(tried):
        yield from min(tried, key=len)


def _properties(value, wanted, _schema, root, at):
    for name, one in wanted.items() if isinstance(value, dict) else ():
        if name in value:
            yield from faults(value[name], one, root, f"{at}.{name}")


def _additional(value, wanted, schema, root, at):
    for name in set(value) - set(schema.get("properties", ())) if isinstance(value, dict) else ():
        if wanted is False:
            yield f"{at} must not have {name}"
        elif isinstance(wanted, dict):
            yield from faults(value[name], wanted, root, f"{at}.{name}")


def _required(value, wanted, _schema, _root, at):
    yield from (f"{at} lacks {name}" for name in wanted if isinstance(value, dict) and name not in value)


def _items(value, wanted, _schema, root, at):
    for index, one in enumerate(value if isinstance(value, list) else ()):
        yield from faults(one, wanted, root, f"{at}[{index}]")


def _holds(test):
    def check(value, wanted, _schema, _root, at):
        if not test(value, wanted):
            yield f"{at} is {value!r}, not within {wanted!r}"

    return check


_KEYWORDS = {
    "type": _type,
    "anyOf": _any_of,
    "properties": _properties,
    "additionalProperties": _additional,
    "required": _required,
    "items": _items,
    "const": _holds(lambda value, wanted: value == wanted),
    "enum": _holds(lambda value, wanted: value in wanted),
    "pattern": _holds(lambda value, wanted: not isinstance(value, str) or re.search(wanted, value)),
    "minLength": _holds(lambda value, wanted: not isinstance(value, str) or len(value) >= wanted),
    "maxLength": _holds(lambda value, wanted: not isinstance(value, str) or len(value) <= wanted),
    "exclusiveMinimum": _holds(lambda value, wanted: not isinstance(value, int | float) or value > wanted),
}
