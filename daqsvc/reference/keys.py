"""Pages of all keys of the machine file, one for each table of the top level."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, get_origin

from daqsvc.reference.markdown import anchored, code, page, table, toml
from daqsvc.settings.json_schema import example_values, key_schema, single_value, tags
from daqsvc.settings.models import machine_file_model
from daqsvc.settings.schema import bare_type, element_type, field_type, is_section, kinds_of
from daqsvc.settings.units_of_keys import unit_of_key

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from pydantic.fields import FieldInfo

    from daqsvc.settings.section import Section

NAME = "NAME"
"""In place of the name that a file gives a bus or a stream."""
_NAME_PATTERN = r"^\.*[A-Za-z0-9_-][A-Za-z0-9_.-]*$"


@dataclass(frozen=True)
class Variant:
    """A key as one kind of table has it.

    Attributes:
        kind: what such a table is called, or what contains it; empty if there is one kind only.
        path: of the table.
        name: the last part of the key.
        field: as its model declares it.
        section: the model.
    """

    kind: str
    path: str
    name: str
    field: FieldInfo
    section: type[Section]

    @property
    def about(self) -> str:
        """What it does, in one sentence."""
        return self.field.description or ""

    @property
    def schema(self) -> dict[str, Any]:
        """What is valid of it."""
        schema = key_schema(self.name, self.field)
        value = single_value(self.section, self.name)
        return schema if value is None else {"const": value, **schema}

    @property
    def default(self) -> str:
        """Its default as TOML, or what there is in place of one."""
        if self.field.is_required():
            return "required"
        default = self.schema.get("default")
        return "none" if default is None else code(toml(default))

    @property
    def example(self) -> str:
        """A line that a file may have; empty for a table, which has a header."""
        values = example_values(self.field)
        schema = self.schema
        if self.field.examples and isinstance(self.field.examples[0], str) and values != self.field.examples:
            return code(f"{self.name} = {self.field.examples[0]}")
        values += [schema[key] for key in ("const", "default") if schema.get(key) not in (None, [], {})]
        values += schema.get("enum", [])[:1]
        return code(f"{self.name} = {toml(values[0])}") if values else ""

    @property
    def is_table(self) -> bool:
        """Whether keys are below it."""
        return _holds_tables(self.schema)

    def row(self) -> tuple[str, ...]:
        """Type, unit, range, default and example."""
        schema, unit = self.schema, unit_of_key(self.name, self.field)
        example = self.example or (
            code(_header(f"{_dotted(self.path, self.name)}", schema)) if self.is_table else ""
        )
        return kind_of_value(schema), unit or "", range_of(schema), self.default, example


@dataclass
class Table:
    """All kinds of tables that can be at one place of the file.

    Attributes:
        path: the place, as people write it.
        kinds: those that can be there, each with what it is called, or what contains it.
        keys: what each of them knows, by key.
    """

    path: str
    kinds: list[tuple[type[Section], str]] = field(default_factory=list)
    keys: dict[str, list[Variant]] = field(default_factory=dict)

    @property
    def header(self) -> str:
        """How it begins in the file."""
        return f"[[{self.path.removesuffix('[]')}]]" if self.path.endswith("[]") else f"[{self.path}]"


def tables() -> dict[str, Table]:
    """Every table of the machine file by its path, those of all plugins with them."""
    by_path: dict[str, Table] = {}

    def walk(declared: Any, path: str, within: str) -> None:
        kinds, bare, element = kinds_of(declared), bare_type(declared), element_type(declared)
        if kinds is not None or is_section(bare):
            here = by_path.setdefault(path, Table(path))
            for section in kinds.sections if kinds is not None else (bare,):
                kind = section.kind or within
                if (section, kind) in here.kinds:
                    continue
                here.kinds.append((section, kind))
                for name, info in section.model_fields.items():
                    here.keys.setdefault(name, []).append(Variant(kind, path, name, info, section))
                for name, info in section.model_fields.items():
                    walk(field_type(info), _dotted(path, name), kind)
        elif element is not None:
            walk(element, f"{path}.{NAME}" if get_origin(bare) is dict else f"{path}[]", within)

    walk(machine_file_model(), "", "")
    return by_path


def gaps() -> Iterator[str]:
    """Keys without a description, or without an example."""
    for path, held in tables().items():
        for name, variants in held.keys.items():
            for one in variants:
                where = f"{_dotted(path, name)} ({one.section.__module__}.{one.section.__qualname__})"
                if not one.about:
                    yield f"{where} has no description"
                if not one.example and not one.is_table:
                    yield f"{where} has neither an example nor a default"


def pages() -> dict[str, str]:
    """Text of each page, by file name."""
    by_path = tables()
    top = by_path[""]
    made = {}
    listed = []
    for name, variants in top.keys.items():
        below = [held for path, held in by_path.items() if _top(path) == name]
        if not below:
            continue
        file = _file(name)
        header = f"[[{name}]]" if any(held.path == f"{name}[]" for held in below) else f"[{name}]"
        if all(held.path.startswith(f"{name}.{NAME}") for held in below):
            header = f"[{name}.{NAME}]"
        number = sum(len(held.keys) for held in below)
        listed.append((f"[`{header}`]({file})", variants[0].about, f"{number}"))
        text = [_table_text(held, by_path) for held in below]
        made[file] = page(f"Keys of `{header}`", f"{_sentence(variants[0].about)} {_HOW}", *text)
    scalars = {name: variants for name, variants in top.keys.items() if not variants[0].is_table}
    made["keys.md"] = page(
        "Keys of the machine file",
        _READ,
        "## Tables",
        table(("table", "what it is for", "keys"), listed),
        "## At the top of the file",
        *(_key_text("", name, variants, top.kinds) for name, variants in scalars.items()),
        "## All keys",
        "\n".join(
            f"- [`{_dotted(path, name)}`]({_file(_top(path)) if path else ''}#{anchor(path, name)})"
            for path, held in by_path.items()
            for name in held.keys
            if path or name in scalars
        ),
    )
    return made


_READ = """Every key, with its type, unit, range, default and an example. A key is named by its path, with
dots: `pipeline.rotor_bank.noise_um` is the key `noise_um` of the table `[pipeline.rotor_bank]`. `NAME`
is a name that you choose: `buses.NAME.driver` is `buses.can0.driver` in your file. `[]` is one of
several tables: `sensors[].name` is the key `name` of each `[[sensors]]`. `daqsvc check` shows what of a file
cannot be used. Editors can show the same ([machine-file.md](../machine-file.md#in-an-editor))."""
_HOW = "How to read this: [keys.md](keys.md)."


def anchor(path: str, name: str) -> str:
    """What links to a key end with: its path without brackets."""
    return _dotted(path, name).replace("[]", "")


def _top(path: str) -> str:
    return path.replace("[]", "").split(".")[0]


def _dotted(path: str, name: str) -> str:
    return f"{path}.{name}" if path else name


def _file(table: str) -> str:
    """The page of a table of the top level."""
    return f"keys-{table.replace('_', '-')}.md"


def _sentence(text: str) -> str:
    text = text[:1].upper() + text[1:]
    return text if text.endswith(".") else f"{text}."


def _table_text(held: Table, by_path: Mapping[str, Table]) -> str:
    above, _, last = held.path.removesuffix("[]").rpartition(".")
    heading = f"## `{held.header}`"
    # A table that is a key of another one has the anchor of that.
    is_key = above in by_path and last in by_path[above].keys and above != ""
    parts = [heading if is_key else anchored(heading, held.path.replace("[]", ""))]
    sections = list(dict.fromkeys(section for section, _ in held.kinds))
    if len(sections) == 1:
        parts.append(_first_line(sections[0]))
    else:
        rows = []
        for section, kind in held.kinds:
            tag_values = tags(section, sections) if section.kind else {}
            by = [f"{key} = {toml(value)}" if value is not None else key for key, value in tag_values.items()]
            keys = ", ".join(
                f"**`{name}`**" if info.is_required() else f"`{name}`"
                for name, info in section.model_fields.items()
            )
            rows.append((kind, ", ".join(map(code, by)), keys))
        parts.append("Several kinds of this table, with their keys; those in bold are required:")
        parts.append(table(("kind", "recognised by", "keys"), rows))
    parts += [_key_text(held.path, name, variants, held.kinds) for name, variants in held.keys.items()]
    return "\n\n".join(parts)


def _first_line(section: type[Section]) -> str:
    return (section.__doc__ or "").strip().partition("\n")[0].replace("``", "`")


def _key_text(path: str, name: str, variants: Sequence[Variant], kinds: Sequence[object]) -> str:
    alike: dict[tuple[str, ...], list[Variant]] = {}
    for one in variants:
        alike.setdefault((one.about, *one.row()), []).append(one)
    heading = anchored(f"### `{_dotted(path, name)}`", anchor(path, name))
    columns: tuple[str, ...] = ("type", "unit", "range", "default", "example")
    abouts = list(dict.fromkeys(about for about, *_ in alike))
    if len(abouts) == 1:
        cut, words = 1, [_sentence(abouts[0])]
    else:
        columns, cut, words = ("what it does", *columns), 0, []
    is_of_all = len(alike) == 1 and len(variants) == len(kinds)
    rows = [
        ("" if is_of_all else "; ".join(one.kind for one in ones), *row[cut:]) for row, ones in alike.items()
    ]
    return "\n\n".join([heading, *words, table(("of", *columns), rows)])


def kind_of_value(schema: Mapping[str, Any]) -> str:
    """What is there, in words."""
    if "const" in schema:
        return code(toml(schema["const"]))
    if "enum" in schema:
        return "one of " + ", ".join(code(toml(value)) for value in schema["enum"])
    if "anyOf" in schema:
        return " or ".join(kind_of_value(one) for one in schema["anyOf"])
    items, words = schema.get("items"), _KINDS.get(schema.get("type", ""), "any value")
    if isinstance(items, list):
        words = f"{len(items)} values, each a {kind_of_value(items[0])}"
    elif isinstance(items, dict):
        words = "list of tables" if "properties" in items else f"list, of each: {kind_of_value(items)}"
    elif isinstance(schema.get("additionalProperties"), dict):
        words = "tables by name"
    return words


_KINDS = {
    "boolean": "`true` or `false`",
    "integer": "whole number",
    "number": "number",
    "string": "text",
    "object": "table",
}


def range_of(schema: Mapping[str, Any]) -> str:
    """What is valid of it beyond its type, in words; empty if everything is."""
    items = schema.get("items")
    if isinstance(items, list):
        return range_of(items[0])
    words = []
    least, most = schema.get("minimum"), schema.get("maximum")
    above, below = schema.get("exclusiveMinimum"), schema.get("exclusiveMaximum")
    if least is not None and most is not None:
        words.append(f"{_number(least)} to {_number(most)}")
    else:
        words += [f"{_number(least)} or more"] if least is not None else []
        words += [f"more than {_number(above)}"] if above is not None else []
        words += [f"{_number(most)} or less"] if most is not None else []
        words += [f"less than {_number(below)}"] if below is not None else []
    words += [schema["$comment"]] if "$comment" in schema else []
    if schema.get("pattern") == _NAME_PATTERN:
        words.append("letters, digits, `_`, `.` and `-`")
    if "maxLength" in schema:
        words.append(f"up to {schema['maxLength']} characters")
    if "maxItems" in schema:
        words.append(f"{schema.get('minItems', 0)} to {schema['maxItems']} entries")
    if isinstance(items, dict) and "properties" not in items and (each := range_of(items)):
        words.append(f"each {each}")
    return ", ".join(words)


def _number(value: float) -> str:
    return f"{int(value):_}" if float(value).is_integer() and abs(value) < 1e10 else f"{value:g}"


def _header(path: str, schema: Mapping[str, Any]) -> str:
    if schema.get("type") == "array":
        return f"[[{path}]]"
    return (
        f"[{path}.{NAME}]" if "additionalProperties" in schema and "properties" not in schema else f"[{path}]"
    )


def _holds_tables(schema: Mapping[str, Any]) -> bool:
    below = (schema, schema.get("items"), schema.get("additionalProperties"))
    return any(isinstance(one, dict) and "properties" in one for one in below)
