"""The JSON Schema of a machine file, for editors: what they complete, explain and underline.

It is made from the models of daqsvc and of all plugins that are installed, so it knows their keys, too. It
is of draft 7, which editors of TOML understand best, and shows what is valid of each value by itself: whether
values fit each other, only `daqsvc check` states.
"""

from __future__ import annotations

import json
import tomllib
from typing import TYPE_CHECKING, Any, Literal, get_args, get_origin

from annotated_types import Ge, Gt, Le, Lt, MaxLen, MinLen
from pydantic_core import PydanticUndefined, to_jsonable_python

from daqsvc.documentation import documented_in
from daqsvc.settings.buses import Bus, Layout
from daqsvc.settings.models import machine_file_model
from daqsvc.settings.registry import bus_tables, first_detector
from daqsvc.settings.schema import adapter, bare_type, element_type, field_type, is_section, kinds_of
from daqsvc.settings.section import NamesDetector, Section
from daqsvc.settings.units_of_keys import unit_of_key

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from pydantic.fields import FieldInfo

    from daqsvc.settings.section import Kinds

Schema = dict[str, Any]
DRAFT = "http://json-schema.org/draft-07/schema#"


def machine_schema() -> Schema:
    """The JSON Schema (draft 7) of a machine file, with the tables of all plugins that are installed."""
    schema = _table(machine_file_model())
    about = (
        f"Everything that a box knows about the machine that it watches. See {documented_in('machine-file')}."
    )
    return {"$schema": DRAFT, "title": "daqsvc machine file", **schema, "description": about}


def machine_schema_text() -> str:
    """The same as the text of a file."""
    return json.dumps(machine_schema(), indent=1, ensure_ascii=False) + "\n"


def key_schema(name: str, field: FieldInfo) -> Schema:
    """What is valid of one key, and what a person should know about it.

    Args:
        name: the key; its end states the unit.
        field: as the model declares it.
    """
    schema = _value(field_type(field))
    words = {"description": description} if (description := field.description) else {}
    unit = unit_of_key(name, field)
    if unit is not None and words:
        words["description"] += f" [{unit}]"
    schema = {**words, **{key: value for key, value in schema.items() if key not in words}}
    if field.default is not None and field.default is not PydanticUndefined:
        default = to_jsonable_python(field.default)
        if not isinstance(field.default, Section):
            schema["default"] = default
    examples = example_values(field)
    if examples:
        schema["examples"] = examples
    return schema


def example_values(field: FieldInfo) -> list[Any]:
    """The examples of a key as values; those that the model gives as TOML are read."""
    if not field.examples and any(isinstance(mark, NamesDetector) for mark in field.metadata):
        first = first_detector()
        return [first] if first else []
    return [value for example in field.examples or () if (value := _example_value(example)) is not None]


def _example_value(example: Any) -> Any:
    if isinstance(example, str) and example.startswith(("[", "{", "0x")):
        try:
            return tomllib.loads(f"value = {example.replace(', ...', '')}")["value"]
        except tomllib.TOMLDecodeError:
            return example
    return example


def single_value(section: type[Section], name: str) -> Any:
    """The only value that a key of a table can have; None if there are several, or no such key."""
    if name == "driver" and issubclass(section, Bus):
        return next((key for key, plugin in bus_tables().items() if section in plugin.buses), None)
    field = section.model_fields.get(name)
    if field is None or not field.is_required():
        return None
    bare = bare_type(field_type(field))
    values = get_args(bare) if get_origin(bare) is Literal else ()
    return values[0] if len(values) == 1 else None


def tags(section: type[Section], kinds: Sequence[type[Section]]) -> Mapping[str, Any]:
    """What tells a table of this kind from those of others: keys, and their values; None if any will do.

    Args:
        section: the kind.
        kinds: it and all others.
    """
    values = {
        name: single_value(section, name)
        for name in section.model_fields
        # A sensor's unit is not enough: some kinds have one of several.
        if all(single_value(kind, name) is not None for kind in kinds if name in kind.model_fields)
    }
    if values:
        return values
    if issubclass(section, Layout) and section.mark:
        return {section.mark: None}
    own = (
        name
        for name, field in section.model_fields.items()
        if field.is_required() and sum(name in kind.model_fields for kind in kinds) == 1
    )
    return dict.fromkeys([*own][:1])


def _value(declared: Any) -> Schema:
    """What is valid where a key of that type stands."""
    kinds, bare, element = kinds_of(declared), bare_type(declared), element_type(declared)
    if kinds is not None:
        return _one_of(kinds)
    if is_section(bare):
        return _table(bare)
    if element is None or not _holds_tables(element):
        return _bounded(_plain(adapter(declared).json_schema()), declared)
    least, most = _lengths(declared)
    if get_origin(bare) is dict:
        return {
            "type": "object",
            **({"minProperties": least} if least else {}),
            **({"maxProperties": most} if most else {}),
            "propertyNames": _plain(adapter(get_args(bare)[0]).json_schema()),
            "additionalProperties": _value(element),
        }
    return {
        "type": "array",
        **({"minItems": least} if least else {}),
        **({"maxItems": most} if most else {}),
        "items": _value(element),
    }


def _bounded(schema: Schema, declared: Any) -> Schema:
    """With the bounds of a number that follow a validator of ours, where pydantic does not see them."""
    if schema.get("type") not in {"number", "integer"}:
        return schema
    marks = getattr(declared, "__metadata__", ())
    bounds = [one for mark in marks for one in (mark, *getattr(mark, "metadata", ()))]
    for bound in bounds:
        for kind, key in _BOUNDS.items():
            if isinstance(bound, kind):
                schema.setdefault(key, _written(getattr(bound, kind.__name__.lower())))
    return schema


_BOUNDS: Mapping[type[Ge | Le | Gt | Lt], str] = {
    Ge: "minimum",
    Le: "maximum",
    Gt: "exclusiveMinimum",
    Lt: "exclusiveMaximum",
}


def _written(bound: float) -> float:
    """A bound as a whole number if it is one: of types that differ by 1 and 1.0 only, Python keeps one."""
    return int(bound) if float(bound).is_integer() and abs(bound) < _LARGE else bound


_LARGE = 1e15


def _holds_tables(declared: Any) -> bool:
    return kinds_of(declared) is not None or is_section(bare_type(declared))


def _lengths(declared: Any) -> tuple[int | None, int | None]:
    least = most = None
    for mark in getattr(declared, "__metadata__", ()):
        for one in (mark, *getattr(mark, "metadata", ())):
            least = one.min_length if isinstance(one, MinLen) else least
            most = one.max_length if isinstance(one, MaxLen) else most
    return least, most


def _table(section: type[Section]) -> Schema:
    """What is valid of a table of this kind."""
    properties = {name: key_schema(name, field) for name, field in section.model_fields.items()}
    for name, schema in properties.items():
        value = single_value(section, name)
        if value is not None and "const" not in schema and "enum" not in schema:
            schema["const"] = value
        if value is not None:
            schema.setdefault("description", "which kind of table this is: its other keys depend on it")
    required = [name for name, field in section.model_fields.items() if field.is_required()]
    return {
        "type": "object",
        "properties": properties,
        **({"required": required} if required else {}),
        **({"additionalProperties": False} if section.model_config.get("extra") == "forbid" else {}),
    }


def _one_of(kinds: Kinds) -> Schema:
    """What is valid of a table of one of several kinds: only the errors of the kind that is meant are shown.

    Editors complete and explain by `properties`: those of all kinds. Of `if` and `then` they show the errors.
    """
    sections = kinds.sections
    if len(sections) == 1:
        return _table(sections[0])
    tables = {section: _table(section) for section in sections}
    names = dict.fromkeys(name for table in tables.values() for name in table["properties"])
    every = [name for name in names if all(name in table.get("required", ()) for table in tables.values())]
    properties = {
        name: _either([t["properties"][name] for t in tables.values() if name in t["properties"]])
        for name in names
    }
    return {
        "type": "object",
        "properties": properties,
        **({"required": every} if every else {}),
        "allOf": [_decided(kinds, {s: _beyond(table, properties, every) for s, table in tables.items()})],
    }


def _beyond(table: Schema, properties: Schema, every: Sequence[str]) -> Schema:
    """A table of one kind, without what holds for all kinds: no error is to be shown twice."""
    own = {
        name: True if schema == properties[name] else schema for name, schema in table["properties"].items()
    }
    required = [name for name in table.get("required", ()) if name not in every]
    return {
        **{key: value for key, value in table.items() if key not in {"type", "required"}},
        "properties": own,
        **({"required": required} if required else {}),
    }


def _decided(kinds: Kinds, tables: Mapping[type[Section], Schema]) -> Schema:
    """The tables, each under the condition that tells its kind."""
    tag_values = {section: tags(section, kinds.sections) for section in kinds.sections}
    fallback = kinds.choose({})
    last: Schema = {}
    untagged = [section for section in tables if all(value is None for value in tag_values[section].values())]
    if fallback in untagged:
        # What has a key that tells another kind is of none that is known: no more is known of it.
        values = {name for tag in tag_values.values() for name, value in tag.items() if value is not None}
        foreign = [{"required": [name]} for name in sorted(values - fallback.model_fields.keys())]
        last = {"if": {"anyOf": foreign}, "else": tables[fallback]} if foreign else tables[fallback]
    for section in reversed(kinds.sections):
        if section is fallback and section in untagged:
            continue
        condition: Schema = {"required": [next(iter(tag_values[section]))]} if tag_values[section] else {}
        values_of = {
            name: {"const": value} for name, value in tag_values[section].items() if value is not None
        }
        if values_of:
            condition["properties"] = values_of
        last = {"if": condition, "then": tables[section], **({"else": last} if last else {})}
    return last


def _either(schemas: Sequence[Schema]) -> Schema:
    """What editors know of a key that is not the same in all kinds of tables.

    Those that differ by the only value that they allow become one list. All others allow anything: which of
    them holds is decided by the kind.
    """
    distinct = [one for number, one in enumerate(schemas) if one not in schemas[:number]]
    if len(distinct) == 1:
        return distinct[0]
    if all("const" in one for one in distinct):
        values = list(dict.fromkeys(one["const"] for one in distinct))
        words = next((one["description"] for one in distinct if "description" in one), None)
        return {**({"description": words} if words else {}), "enum": values}
    return {"anyOf": [*distinct, {"additionalProperties": True}]}


def _plain(schema: Schema) -> Schema:
    """A schema of pydantic as draft 7 has it, without what TOML does not know."""
    arms = [arm for arm in schema.get("anyOf", ()) if arm != {"type": "null"}]
    if len(arms) == 1:
        schema = {
            **{key: value for key, value in schema.items() if key not in {"anyOf", "default"}},
            **arms[0],
        }
    plain: Schema = {}
    for key, value in schema.items():
        if key == "prefixItems":
            plain["items"] = [_plain(item) for item in value]
        elif key in {"items", "additionalProperties"} and isinstance(value, dict):
            plain[key] = _plain(value)
        elif key == "anyOf":
            plain[key] = [_plain(arm) for arm in value]
        elif key in _BOUNDS.values():
            plain[key] = _written(value)
        elif key not in {"title", "format"}:
            plain[key] = value
    return plain
