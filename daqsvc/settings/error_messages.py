"""What pydantic found, in words for the person who wrote the file."""

from __future__ import annotations

import json
import re
from difflib import get_close_matches
from typing import TYPE_CHECKING, Any, get_args, get_origin

from pydantic import ValidationError

from daqsvc.errors.machine_file import (
    BAD_NAME,
    BAD_TEXT,
    MISSING_KEY,
    NOT_ONE_OF,
    OUT_OF_RANGE,
    SECRET_IN_FILE,
    UNKNOWN_KEY,
    VALUE_REFUSED,
    WRONG_LENGTH,
    WRONG_TYPE,
)
from daqsvc.rounding import counted
from daqsvc.settings.aliases import meant_key
from daqsvc.settings.buses import Layout
from daqsvc.settings.measures import ON_REQUEST, Measure
from daqsvc.settings.registry import first_detector
from daqsvc.settings.schema import (
    adapter,
    declared_at,
    homes_of,
    is_table,
    kinds_by_word,
    kinds_of,
    may_be_table,
    plural_of,
    section_of,
    value_at,
    words_of,
)
from daqsvc.settings.section import NamesDetector
from daqsvc.settings.written_numbers import as_toml, number_meant, with_digits

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from pydantic.fields import FieldInfo
    from pydantic_core import ErrorDetails

    from daqsvc.errors.code import Code
    from daqsvc.settings.problems import KeyPath
    from daqsvc.settings.section import Section

_TRUE_WORDS = {"1", "on", "true", "y", "yes", "ja", "j", "oui", "si"}
_FALSE_WORDS = {"0", "off", "false", "n", "no", "nein", "non"}
_MOST_IN_A_ROW = 4
"""Values that belong together, e.g. the two ends of a range; whatever may be longer is a list."""
_NO_VECTOR = (0.0, 0.0)
"""Default of a key that takes two parts of a vector, and does nothing without them."""
_OF_CANDUMP = "write the id of the frames, which candump shows"
_SECRET = re.compile(r"pass|secret|token|credential", re.IGNORECASE)


_CODES: Mapping[str, Code] = {
    "missing": MISSING_KEY,
    "extra_forbidden": UNKNOWN_KEY,
    **dict.fromkeys(
        (
            *("bool_type", "int_type", "float_type", "string_type", "path_type"),
            *("tuple_type", "model_type", "section_type", "dict_type"),
        ),
        WRONG_TYPE,
    ),
    **dict.fromkeys(
        ("finite_number", "greater_than", "greater_than_equal", "less_than", "less_than_equal"), OUT_OF_RANGE
    ),
    "literal_error": NOT_ONE_OF,
    "string_pattern_mismatch": BAD_NAME,
    "string_too_short": BAD_TEXT,
    "string_too_long": BAD_TEXT,
    "too_short": WRONG_LENGTH,
    "too_long": WRONG_LENGTH,
}
"""By the type that pydantic gives an error; what is not listed is refused by a validator."""


def dotted(path: KeyPath) -> str:
    """A key path as people write it, e.g. ``sensors[0].name``; keys that need quotes get them."""
    text = ""
    for step in path:
        if isinstance(step, int):
            text += f"[{step}]"
        else:
            key = step if re.fullmatch(r"[A-Za-z0-9_-]+", step) else json.dumps(step, ensure_ascii=False)
            text += f".{key}" if text else key
    return text


def is_secret(path: KeyPath) -> bool:
    """Whether the value at ``path`` must not be repeated in a message."""
    key = next((step for step in reversed(path) if isinstance(step, str)), "")
    return bool(_SECRET.search(key)) and not key.endswith(("_file", "_credential"))


def suggested_key(section: type[Section], table: Mapping[str, Any], key: str) -> str | None:
    """The key of ``section`` that an unknown ``key`` was probably meant to be."""
    free = [name for name in section.model_fields if name not in table]
    if plural_of(section, key, table.get(key)) is not None:
        return next((name for name in free if name in {f"{key}s", f"{key}es"}), None)
    if is_table(table.get(key)):
        free = [name for name in free if may_be_table(section, name)]
    return meant_key(key, free)


def table_beside(section: type[Section], table: Mapping[str, Any], key: str, value: object) -> str | None:
    """The table of ``section`` that an unknown table ``key`` belongs to, which ``table`` has as well."""
    if not is_table(value):
        return None
    here = [name for name in table if name in section.model_fields and is_table(table[name])]
    return meant_key(key, here)


def _shown(limit: float) -> str:
    return f"{limit:g}" if abs(limit) < 1_000_000 else f"{limit:,.0f}"


class ErrorFormatter:
    """Turns one error of pydantic into a message and a remedy.

    Args:
        root: the model of the whole file.
        document: the parsed file that was validated.
    """

    def __init__(self, root: type[Section], document: Mapping[str, Any]) -> None:
        self._root = root
        self._document = document

    def say(self, error: ErrorDetails, path: KeyPath) -> tuple[str, str, Code]:
        """Message (to be read after the value), remedy and code for an error at ``path``."""
        context = error.get("ctx", {})
        code: Code = context.get("code", _CODES.get(error["type"], VALUE_REFUSED))
        if error["type"] == "extra_forbidden" and is_secret(path):
            code = SECRET_IN_FILE
        elif error["type"] == "missing" and isinstance(path[-1], int):
            code = WRONG_LENGTH
        if "remedy" in context:
            return error["msg"], str(context["remedy"]), code
        say: Callable[[KeyPath, Mapping[str, Any]], tuple[str, str]]
        say = getattr(self, f"_{error['type']}", self._other)
        message, remedy = say(path, context)
        # Of a validator that raises a ValueError pydantic states "Value error, " before its words.
        message = message or f"is not valid: {str(context.get('error', '')) or error['msg']}"
        return message, remedy, code

    # Each method below is named after the pydantic error type it puts into words.

    def _missing(self, path: KeyPath, _context: Mapping[str, Any]) -> tuple[str, str]:
        if isinstance(path[-1], int):
            return "is missing: the array needs one more value", self._write_example(path)
        field = self._field(path)
        about = f": {field.description}" if field is not None and field.description else ""
        return f"is missing{about}", self._add(path)

    def _extra_forbidden(self, path: KeyPath, _context: Mapping[str, Any]) -> tuple[str, str]:
        key = str(path[-1])
        table = value_at(self._document, path[:-1])
        declared = declared_at(self._root, self._document, path[:-1])
        section = section_of(declared, table)
        if section is None:
            raise LookupError(path)
        kinds = kinds_of(declared)
        others = [other.kind for other in (kinds.sections if kinds else ()) if key in other.model_fields]
        meant = None if is_secret(path) else suggested_key(section, table, key)
        needed = meant is not None and section.model_fields[meant].is_required()
        if others and not needed:
            return f"belongs to {' or '.join(others)}, but this is {section.kind}", "remove it"
        if is_secret(path):
            return (
                "does not belong into a machine file",
                "write it into a file that only the service can read and name that in password_file",
            )
        several = plural_of(section, key, value_at(self._document, path))
        if several is not None:
            header = dotted((*path[:-1], several))
            is_array = isinstance(value_at(self._document, path), list)
            return "unknown key", f"write [[{header}]]" if is_array else f"write [{header}.NAME]"
        if meant is None and not is_secret(path):
            meant = table_beside(section, table, key, table[key])
        if meant is not None:
            return "unknown key", f"did you mean {meant}?"
        homes = homes_of(self._root, path, self._document)
        if homes:
            return "unknown key", f"move it to {' or '.join(homes)}, where it belongs"
        free = sorted(name for name in section.model_fields if name not in table)
        keys = f"; possible here: {', '.join(free)}" if free else ""
        return "unknown key", f"remove it{keys}"

    def _bool_type(self, path: KeyPath, _context: Mapping[str, Any]) -> tuple[str, str]:
        word = str(value_at(self._document, path)).lower()
        meant = "true" if word in _TRUE_WORDS else "false" if word in _FALSE_WORDS else "true or false"
        return "must be true or false", f"write {self._key(path)} = {meant}"

    def _int_type(self, path: KeyPath, _context: Mapping[str, Any]) -> tuple[str, str]:
        value = value_at(self._document, path)
        if isinstance(value, str):
            try:
                int(value, 0)
            except ValueError:
                pass
            else:
                return "must be a whole number", f"take the quotes away: {self._key(path)} = {value}"
        if isinstance(value, float) and value.is_integer():
            return "must be a whole number", f"write {self._key(path)} = {int(value)}"
        return "must be a whole number", self._write_meant(path, value, whole=True)

    def _float_type(self, path: KeyPath, _context: Mapping[str, Any]) -> tuple[str, str]:
        value = value_at(self._document, path)
        if isinstance(value, str) and re.fullmatch(r"[+-]?\d+(\.\d+)?([eE][+-]?\d+)?", value.strip()):
            return "must be a number", f"take the quotes away: {self._key(path)} = {value.strip()}"
        return "must be a number", self._write_meant(path, value, whole=False)

    def _finite_number(self, path: KeyPath, _context: Mapping[str, Any]) -> tuple[str, str]:
        return "must be a finite number", self._write_example(path)

    def _string_type(self, path: KeyPath, _context: Mapping[str, Any]) -> tuple[str, str]:
        value = value_at(self._document, path)
        if isinstance(value, bool | int | float) and self._is_valid(path, f"{value}"):
            return "must be text in quotes", f"write {self._key(path)} = {json.dumps(str(value))}"
        return "must be text in quotes", self._write_example(path)

    def _is_valid(self, path: KeyPath, value: object) -> bool:
        """Whether a value could be there by itself."""
        try:
            adapter(declared_at(self._root, self._document, path)).validate_python(value)
        except (LookupError, ValidationError):
            return False
        return True

    def _path_type(self, path: KeyPath, _context: Mapping[str, Any]) -> tuple[str, str]:
        return "must be a path in quotes", self._write_example(path)

    def _literal_error(self, path: KeyPath, _context: Mapping[str, Any]) -> tuple[str, str]:
        value = value_at(self._document, path)
        allowed = self._allowed(path)
        listed = [json.dumps(item) for item in allowed]
        if value in get_args(Measure) and set(ON_REQUEST).issuperset(allowed):
            return (
                "needs no entry: it is always computed where the sensor gives it",
                "take it out of the array",
            )
        message = (
            f"must be {' or '.join([', '.join(listed[:-1]), listed[-1]] if len(listed) > 1 else listed)}"
        )
        if len(allowed) == 1:
            return message, f"write {self._key(path)} = {listed[0]}"
        usual = self._example(path)
        example = usual if usual in listed else listed[0]
        if isinstance(value, str):
            if value in {str(item) for item in allowed}:
                return message, f"take the quotes away: {self._key(path)} = {value}"
            meant = _meant(value, [item for item in allowed if isinstance(item, str)])
            if meant is not None:
                return message, f'did you mean "{meant}"?'
        return message, f"write one of these, e.g. {self._key(path)} = {example}"

    def _greater_than(self, path: KeyPath, context: Mapping[str, Any]) -> tuple[str, str]:
        return f"must be greater than {context['gt']:g}", self._write_example(path)

    def _greater_than_equal(self, path: KeyPath, context: Mapping[str, Any]) -> tuple[str, str]:
        if path[-1] == "id":
            return f"must be {context['ge']} or more", _OF_CANDUMP
        return f"must be {_shown(context['ge'])} or more", self._write_example(path)

    def _less_than(self, path: KeyPath, context: Mapping[str, Any]) -> tuple[str, str]:
        return f"must be less than {context['lt']:g}", self._write_example(path)

    def _less_than_equal(self, path: KeyPath, context: Mapping[str, Any]) -> tuple[str, str]:
        limit = context["le"]
        if path[-1] == "id":
            return f"must be {limit:#x} or less", _OF_CANDUMP
        return f"must be {_shown(limit)} or less", self._write_example(path)

    def _string_pattern_mismatch(self, path: KeyPath, context: Mapping[str, Any]) -> tuple[str, str]:
        parts = "/" in str(context["pattern"])
        also = " (and '/' between parts)" if parts else ""
        # The key of a free table is checked by the name it has, not by what it holds.
        key, value = path[-1], value_at(self._document, path)
        named = isinstance(value, str)
        text = value if named else str(key)
        allowed = re.sub(r"[^A-Za-z0-9_./-]+" if parts else r"[^A-Za-z0-9_.-]+", "-", text).strip("-/")
        subject = "" if named else "its name "
        message = f"{subject}may only have letters, digits, '_', '.' and '-'{also}, and must not be empty"
        if text and not parts and not text.strip("."):
            return f"{message}; dots alone are no name", "give it a name"
        remedy = f"write e.g. {json.dumps(allowed)}" if allowed.strip(".") else "give it a name"
        return message, remedy

    def _string_too_short(self, path: KeyPath, _context: Mapping[str, Any]) -> tuple[str, str]:
        return "must not be empty", self._write_example(path)

    def _string_too_long(self, _path: KeyPath, context: Mapping[str, Any]) -> tuple[str, str]:
        return f"is longer than {context['max_length']} characters", "shorten it"

    def _too_short(self, path: KeyPath, context: Mapping[str, Any]) -> tuple[str, str]:
        least = context["min_length"]
        number = "one entry" if least == 1 else f"{least} entries"
        return f"must have at least {number}", self._add(path)

    def _too_long(self, path: KeyPath, context: Mapping[str, Any]) -> tuple[str, str]:
        most = context["max_length"]
        if isinstance(value_at(self._document, path), str):
            # Of one character there can only be none fewer, which is empty.
            words = f"must have {most} characters at most" if most > 1 else "must be 1 character"
            return words, self._write_example(path)
        if most > _MOST_IN_A_ROW:
            return f"has more than {most:,} entries", "leave some out, or watch the rest with another service"
        return f"must have {counted(most, 'value')}", self._write_example(path)

    def _tuple_type(self, path: KeyPath, _context: Mapping[str, Any]) -> tuple[str, str]:
        field = self._field(path)
        value = value_at(self._document, path)
        if field is not None and field.default == _NO_VECTOR and isinstance(value, int | float):
            # The default would undo what was meant; of sag, most is downwards.
            example = [0.0, 0.0 - abs(float(value))]
            if self._is_valid(path, example):
                return "must be two numbers in brackets, x and y", (
                    f"write e.g. {self._key(path)} = {json.dumps(example)} ({field.description})"
                )
        if field is not None and not field.examples:
            return "must be an array", self._add(path)
        return "must be an array in brackets", self._write_example(path)

    def _model_type(self, path: KeyPath, _context: Mapping[str, Any]) -> tuple[str, str]:
        return "must be a table", self._add(path)

    _section_type = _dict_type = _model_type

    def _other(self, path: KeyPath, _context: Mapping[str, Any]) -> tuple[str, str]:
        return "", self._write_example(path)

    # What the remedies are made of.

    def _key(self, path: KeyPath) -> str:
        """The last key of a path; elements of an array of values go by the array's name and position."""
        names = [depth for depth, step in enumerate(path) if isinstance(step, str)]
        return dotted(path[names[-1] :]) if names else dotted(path)

    def _field(self, path: KeyPath) -> FieldInfo | None:
        """The field of the models that ``path`` belongs to."""
        for depth in range(len(path), 0, -1):
            step = path[depth - 1]
            try:
                table = value_at(self._document, path[: depth - 1])
            except LookupError:
                continue
            section = section_of(declared_at(self._root, self._document, path[: depth - 1]), table)
            if section is not None and step in section.model_fields:
                return section.model_fields[str(step)]
        return None

    def _allowed(self, path: KeyPath) -> tuple[Any, ...]:
        """The words that may be at ``path``; if they decide on the kind of the table, those of all kinds."""
        kinds = kinds_of(declared_at(self._root, self._document, path[:-1]))
        if kinds is None:
            return words_of(declared_at(self._root, self._document, path))
        return tuple(kinds_by_word(kinds, value_at(self._document, path[:-1]), str(path[-1])))

    def _example(self, path: KeyPath) -> str | None:
        """A valid value as TOML, from the field's examples or its default."""
        field = self._field(path)
        if field is None:
            return None
        if field.examples:
            example = self._usual_rate_hz(path) or field.examples[0]
            # Examples that are TOML already: arrays, inline tables, hexadecimal numbers.
            if isinstance(example, str) and example.startswith(("[", "{", "0x")):
                return example
            return json.dumps(example)
        if any(isinstance(mark, NamesDetector) for mark in field.metadata):
            name = first_detector()
            return None if name is None else json.dumps(name)
        if isinstance(field.default, bool | int | float | str | tuple):
            return json.dumps(field.default)
        return None

    def _usual_rate_hz(self, path: KeyPath) -> float | None:
        """Of the rate of a stream whose layout is known: what is usual depends on that."""
        if len(path) != 3 or (path[0], path[-1]) != ("streams", "rate_hz"):
            return None
        at = (*path[:-1], "layout")
        try:
            layout = section_of(declared_at(self._root, self._document, at), value_at(self._document, at))
        except LookupError:
            return None
        return layout.usual_rate_hz if layout is not None and issubclass(layout, Layout) else None

    def _write_example(self, path: KeyPath) -> str:
        example = self._example(path)
        field = self._field(path)
        names = [depth for depth, step in enumerate(path) if isinstance(step, str)]
        key = dotted(path[names[-1] : names[-1] + 1])
        about = f" ({field.description})" if field is not None and field.description else ""
        return f"write {key} = {example}{about}" if example else f"correct {key}{about}"

    def _write_meant(self, path: KeyPath, value: object, *, whole: bool) -> str:
        """The number that a text begins with, if it is a valid one; else an example."""
        meant = number_meant(value, str(path[-1])) if isinstance(value, str) else None
        supposed = ""
        if isinstance(value, str) and (alike := with_digits(value)) is not None:
            meant, supposed = float(alike[0]), f", {alike[1]}"
        if meant is None or isinstance(path[-1], int) or (whole and not meant.is_integer()):
            return self._write_example(path)
        if not self._is_valid(path, int(meant) if whole else meant):
            return self._write_example(path)
        return f"write {self._key(path)} = {as_toml(meant, whole=whole)}{supposed or ', a number alone'}"

    def _add(self, path: KeyPath) -> str:
        """How to add what is missing at ``path``, or to make a table of it."""
        key = dotted(path[-1:])
        example = self._example(path)
        if example is not None:
            return f"add {key} = {example} to {self._table(path[:-1])}"
        declared = declared_at(self._root, self._document, path)
        if get_origin(declared) is not None and path in {("sensors",), ("alarms",)}:
            return f"write a table [[{key}]] for each of the {key}"
        if path in {("buses",), ("streams",)}:
            return f"write a table [{key}.NAME] for each of the {key}"
        return f"write a table [{dotted(path)}]"

    def _table(self, path: KeyPath) -> str:
        """The table at ``path``, as a person would point at it."""
        if not path:
            return "the top of the file"
        table = value_at(self._document, path)
        name = table.get("name") if isinstance(table, dict) else None
        if isinstance(path[-1], int):
            named = f' "{name}"' if isinstance(name, str) else ""
            return f"the entry{named} of {dotted(path[:-1])}"
        return f"[{dotted(path)}]"


def _meant(word: str, allowed: Sequence[str]) -> str | None:
    """Which of some words was meant: one in other case, the commonest that begins so, or the most alike."""
    plain = word.lower()
    begun = [one for one in allowed if one.lower() == plain] or [
        one for one in allowed if len(plain) > 2 and one.lower().startswith(plain)
    ]
    if begun:
        # Of numbers of several widths most devices send those of 32 bits, or of 16.
        return next((one for one in begun if one.endswith("32")), begun[0])
    close = get_close_matches(plain, allowed, n=1)
    return close[0] if close else None
