"""The JSON Schema of JSON that a program writes, from the types that it is written by.

Objects are `typing.TypedDict` or pydantic's models; a `typing.NamedTuple` or a dataclass behind a ``dict`` in
``Annotated`` is one that is written by its fields, and a text there names a payload that the object is.
"""

from __future__ import annotations

import dataclasses
import inspect
import types
from collections.abc import Mapping
from typing import (
    TYPE_CHECKING,
    Annotated,
    Any,
    Literal,
    NotRequired,
    Union,
    get_args,
    get_origin,
    get_type_hints,
    is_typeddict,
)

from pydantic import BaseModel

from daqsvc.publish.payloads import CausePayload
from daqsvc.publish.schemas import PAYLOADS
from daqsvc.reference.counters import attributes

if TYPE_CHECKING:
    from collections.abc import Sequence

DIALECT = "https://json-schema.org/draft/2020-12/schema"
_PLAIN = {
    int: "integer",
    float: "number",
    str: "string",
    bool: "boolean",
    type(None): "null",
}
STATEMENT = "statement"
"""A statement of a detector in `Annotated`: of a machine, without the time by the wall clock."""


def schema_of(name: str, kinds: Sequence[tuple[type[Any], ...]], *, taken_in: bool = False) -> dict[str, Any]:
    """The schema of what is any of some types.

    Args:
        name: what it is called.
        kinds: the types of the whole object, each with others whose keys it has, too.
        taken_in: whether the program reads it, and does with what has a default left out.
    """
    held: dict[str, Any] = {}
    arms = []
    for kind, *others in kinds:
        arms.append(_schema(kind, held, taken_in=taken_in))
        for other in others:
            _schema(other, held, taken_in=taken_in)
            joined, more = held[kind.__name__], held.pop(other.__name__)
            joined["properties"] |= more["properties"]
            joined["required"] = list(dict.fromkeys([*joined["required"], *more["required"]]))
    whole = {"anyOf": arms} if len(kinds) > 1 else held.pop(kinds[0][0].__name__)
    return {"$schema": DIALECT, "$id": name.replace(" ", "-"), **whole, **({"$defs": held} if held else {})}


def about(kind: type[Any]) -> str:
    """The first sentence of the description of a type."""
    return inspect.cleandoc(kind.__doc__ or "").partition("\n\n")[0].replace("``", "`").replace("\n", " ")


def _schema(kind: Any, held: dict[str, Any], *, taken_in: bool) -> dict[str, Any]:  # noqa: C901 - a branch a kind
    """The schema of a type; those of objects go into ``held``.

    Raises:
        TypeError: it is none of those that JSON has.
    """

    def of(one: Any) -> dict[str, Any]:
        return _schema(one, held, taken_in=taken_in)

    origin, args = get_origin(kind), get_args(kind)
    made: dict[str, Any] | None = None
    if kind is Any or kind is object:
        made = {}
    elif kind in _PLAIN:
        made = {"type": _PLAIN[kind]}
    elif origin is Literal:
        made = {"const": args[0]} if len(args) == 1 else {"enum": list(args)}
    elif origin in {Union, types.UnionType}:
        made = {"anyOf": [of(one) for one in args]}
    elif origin is list:
        made = {"type": "array", "items": of(args[0])}
    elif origin in {dict, Mapping}:
        made = {"type": "object", "additionalProperties": True if args[1] is Any else of(args[1])}
    elif origin is Annotated:
        made = _payload(args[1], held) if isinstance(args[1], str) else of(args[1])
    elif isinstance(kind, type) and issubclass(kind, BaseModel):
        made = _model(kind, held, taken_in=taken_in)
    elif is_typeddict(kind) or dataclasses.is_dataclass(kind) or hasattr(kind, "_asdict"):
        made = _object(kind, held, taken_in=taken_in)
    if made is None:
        raise TypeError(f"{kind} is no type of JSON that is known here")
    return made


def _object(kind: type[Any], held: dict[str, Any], *, taken_in: bool) -> dict[str, Any]:
    reference = {"$ref": f"#/$defs/{kind.__name__}"}
    if kind.__name__ in held:
        return reference
    held[kind.__name__] = {}
    words, required, properties = attributes(kind), [], {}
    for name, hint in get_type_hints(kind, include_extras=True).items():
        is_optional = get_origin(hint) is NotRequired
        if not is_optional:
            required.append(name)
        inner = get_args(hint)[0] if is_optional else hint
        described = {"description": words[name]} if name in words else {}
        properties[name] = {**_schema(inner, held, taken_in=taken_in), **described}
    held[kind.__name__] = {
        "title": kind.__name__,
        "description": about(kind),
        "type": "object",
        "properties": properties,
        "required": required,
    }
    return reference


def _model(kind: type[BaseModel], held: dict[str, Any], *, taken_in: bool) -> dict[str, Any]:
    mode: Literal["validation", "serialization"] = "validation" if taken_in else "serialization"
    schema = kind.model_json_schema(by_alias=True, mode=mode)
    held |= schema.pop("$defs", {})
    held[kind.__name__] = schema
    return {"$ref": f"#/$defs/{kind.__name__}"}


def _payload(name: str, held: dict[str, Any]) -> dict[str, Any]:
    if name != STATEMENT:
        return _model(PAYLOADS[name], held, taken_in=False)
    reference = _model(CausePayload, held, taken_in=False)
    whole: dict[str, Any] = held.pop("CausePayload")
    words = {"type": "string", "description": "name of the machine"}
    held["Statement"] = {
        **whole,
        "title": "Statement",
        "description": "One statement of one detector.",
        "properties": {"machine": words, **whole["properties"]},
        "required": ["machine", *whole["required"]],
    }
    return {"$ref": reference["$ref"].replace("CausePayload", "Statement")}


def lacking(schema: Mapping[str, Any]) -> list[str]:
    """The fields of a schema that nothing describes, by their objects."""
    objects = [schema, *schema.get("$defs", {}).values()]
    return [
        f"{one.get('title', '')}.{name}"
        for one in objects
        for name, field in one.get("properties", {}).items()
        if not field.get("description")
    ]
