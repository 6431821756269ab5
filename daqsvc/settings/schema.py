"""Finding one's way through the models by the keys of a machine file, and reading what is valid of one."""

from __future__ import annotations

from functools import cache
from types import UnionType
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeGuard, Union, get_args, get_origin

from pydantic import ConfigDict, TypeAdapter, ValidationError

from daqsvc.settings.section import FrozenTables, Kinds, Section

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from pydantic.fields import FieldInfo
    from pydantic_core import ErrorDetails

    from daqsvc.settings.problems import KeyPath

_STRICT = ConfigDict(strict=True, allow_inf_nan=False)


def value_at(document: Any, path: KeyPath) -> Any:
    """The value at a path of a parsed TOML document.

    Raises:
        LookupError: there is none.
    """
    value = document
    for step in path:
        container: type[Any] = list if isinstance(step, int) else dict
        if not isinstance(value, container):
            raise LookupError(path)  # noqa: TRY004 - the path leads nowhere, whatever stands there
        value = value[step]
    return value


_MOST_HOMES = 2
_field_types: dict[int, tuple[FieldInfo, Any]] = {}
_adapters: dict[int, tuple[Any, TypeAdapter[Any]]] = {}
"""Both by the identity of what they belong to, which is kept: else it could become that of something else."""


def field_type(field: FieldInfo) -> Any:
    """The type of a field with its annotations, as it was declared."""
    known = _field_types.get(id(field))
    if known is None:
        declared = Annotated[field.annotation, *field.metadata] if field.metadata else field.annotation
        known = _field_types[id(field)] = (field, declared)
    return known[1]


def section_of(declared: Any, value: object) -> type[Section] | None:
    """The section that a key of type ``declared`` means by ``value``; None if it does not mean a table."""
    kinds = kinds_of(declared)
    if kinds is not None:
        return kinds.choose(value) if isinstance(value, dict) else None
    bare = bare_type(declared)
    return bare if is_section(bare) else None


def kinds_of(declared: Any) -> Kinds | None:
    """The kinds of tables that a key of type ``declared`` can hold, if there are several."""
    if get_origin(declared) is not Annotated:
        return None
    return next((mark for mark in declared.__metadata__ if isinstance(mark, Kinds)), None)


def words_of(declared: Any) -> tuple[Any, ...]:
    """The words that a value of type ``declared`` may be; none if it may be others."""
    while get_origin(declared) is not Literal:
        if not (parts := get_args(declared)):
            return ()
        declared = parts[0]
    return get_args(declared)


def kinds_by_word(kinds: Kinds, table: Mapping[str, Any], key: str) -> dict[Any, type[Section]]:
    """By the words that a key of a table may be: the kind that the table then is of."""

    def words(section: type[Section]) -> tuple[Any, ...]:
        return words_of(field_type(section.model_fields[key])) if key in section.model_fields else ()

    listed = dict.fromkeys(word for section in kinds.sections for word in words(section))
    chosen = {word: kinds.choose({**table, key: word}) for word in listed}
    return {word: section for word, section in chosen.items() if word in words(section)}


def declared_at(root: type[Section], document: Any, path: KeyPath) -> Any:
    """The declared type of what is at ``path``; None if the models know nothing there."""
    declared: Any = root
    for depth, step in enumerate(path):
        value = value_at(document, path[:depth])
        section = section_of(declared, value)
        if section is None:
            declared = element_type(declared)
        elif step in section.model_fields:
            declared = field_type(section.model_fields[str(step)])
        else:
            return None
    return declared


@cache
def _homes(root: type[Section]) -> Mapping[str, tuple[str, ...]]:
    """Every key of the format, with the tables that can hold it."""
    homes: dict[str, list[str]] = {}

    def walk(declared: Any, path: str) -> None:
        kinds, bare = kinds_of(declared), bare_type(declared)
        element = element_type(declared)
        if kinds is not None or is_section(bare):
            for section in kinds.sections if kinds is not None else (bare,):
                for name, field in section.model_fields.items():
                    places = homes.setdefault(name, [])
                    if path and path not in places:
                        places.append(path)
                    walk(field_type(field), f"{path}.{name}" if path else name)
        elif element is not None:
            several = f"{path}.NAME" if get_origin(bare) is dict else f"[{path}]"
            walk(element, path if "." in path and get_origin(bare) is tuple else several)

    walk(root, "")
    return {name: tuple(places) for name, places in homes.items()}


def forget_homes() -> None:
    """Look again which tables can hold a key: other plugins bring other tables."""
    _homes.cache_clear()


def homes_of(root: type[Section], path: KeyPath, document: Any) -> tuple[str, ...]:
    """The other tables of a document that can hold a key, as people write them; none if of many kinds."""
    places = _homes(root).get(str(path[-1]), ())
    if len(places) > _MOST_HOMES:
        return ()
    here = [str(step) for step in path[:-1] if not isinstance(step, int)]
    homes = {place: place.strip("[]").split(".") for place in places}
    return tuple(
        f"[{place}]"
        for place, names in homes.items()
        if _has_table(document, names) and not _same_table(names, here)
    )


def _same_table(names: list[str], here: list[str]) -> bool:
    """Whether the names of a table, with ``NAME`` for any, are those of the table at ``here``."""
    return len(names) == len(here) and all(
        name in {"NAME", step} for name, step in zip(names, here, strict=True)
    )


def _has_table(document: Any, names: list[str]) -> bool:
    """Whether a document has a table, with any name in place of ``NAME``."""
    if isinstance(document, list):
        return any(_has_table(item, names) for item in document)
    if not names or not isinstance(document, dict):
        return not names and isinstance(document, dict)
    name, *others = names
    below = document.values() if name == "NAME" else (document[name],) if name in document else ()
    return any(_has_table(item, others) for item in below)


def is_table(value: object) -> bool:
    """Whether a value is a table, or an array of tables."""
    return isinstance(value, dict) or (
        isinstance(value, list) and bool(value) and all(isinstance(item, dict) for item in value)
    )


def may_be_table(section: type[Section], name: str) -> bool:
    """Whether a key of a section holds a table, several of them, or one with free keys."""
    declared = field_type(section.model_fields[name])
    bare = bare_type(declared)
    element = element_type(declared)
    tables = element is not None and (kinds_of(element) is not None or is_section(bare_type(element)))
    return kinds_of(declared) is not None or is_section(bare) or get_origin(bare) is dict or tables


def plural_of(section: type[Section], key: str, value: object) -> str | None:
    """The key of several tables that was meant by a table whose name lacks its ``s``; None if none was."""
    name = next((name for name in section.model_fields if name in {f"{key}s", f"{key}es"}), None)
    if name is None or not is_table(value):
        return None
    element = element_type(field_type(section.model_fields[name]))
    return name if section_of(element, {}) is not None else None


def only_follows(error: ErrorDetails, document: Any) -> bool:
    """Whether an array or table is too short only because pydantic left out what has errors of its own."""
    if error["type"] != "too_short":
        return False
    least: int = error["ctx"]["min_length"]
    return len(value_at(document, error["loc"])) >= least


def without_guesses(
    errors: Sequence[ErrorDetails], root: type[Section], document: Any
) -> Iterator[ErrorDetails]:
    """Errors without those that a table has only if it is of the kind that was assumed.

    Where the key that decides on the kind is wrong or missing, only what holds for all kinds is an error.
    """
    undecided: dict[KeyPath, tuple[str, list[type[Section]]]] = {}
    for error in errors:
        if error["type"] in {"literal_error", "missing"}:
            *_, key = path = error["loc"]
            kinds = kinds_of(declared_at(root, document, path[:-1]))
            possible = kinds_by_word(kinds, value_at(document, path[:-1]), str(key)) if kinds else {}
            if len({*possible.values()}) > 1:
                undecided[path[:-1]] = (str(key), [*possible.values()])

    def is_guess(path: KeyPath, *, missing: bool) -> bool:
        for depth, key in enumerate(path):
            deciding, sections = undecided.get(path[:depth], (key, []))
            if key != deciding:
                fields = [section.model_fields.get(str(key)) for section in sections]
                of_itself = missing and depth == len(path) - 1
                declared = [
                    field and (field.is_required() if of_itself else field.annotation) for field in fields
                ]
                if any(one != declared[0] for one in declared):
                    return True
        return False

    return (error for error in errors if not is_guess(error["loc"], missing=error["type"] == "missing"))


def valid_part(section: type[Section], table: Mapping[str, Any]) -> Section:
    """The section with those values of ``table`` that are valid, each for itself, at any depth.

    Returns:
        An instance that raises `UnusableValueError` for the values that are missing or not valid.
    """
    values: dict[str, Any] = {}
    unusable: list[str] = []
    for name, field in section.model_fields.items():
        if name in table:
            try:
                values[name] = _valid_value(field_type(field), table[name])
            except (ValidationError, TypeError):
                unusable.append(name)
    part = section.model_construct(**values)
    for name in unusable:
        part.__dict__.pop(name, None)  # the default is not what the file states
    return part


def _valid_value(declared: Any, value: Any) -> Any:
    try:
        return adapter(declared).validate_python(value)
    except ValidationError as error:
        if any(not item["loc"] and not only_follows(item, value) for item in error.errors()):
            raise  # the whole is wrong, not something in it
        section = section_of(declared, value)
        if section is not None and isinstance(value, dict):
            return valid_part(section, value)
        container, element = get_origin(bare_type(declared)), element_type(declared)
        if section_of(element, {}) is not None:
            if container is dict and isinstance(value, dict):
                return FrozenTables({key: _valid_value(element, item) for key, item in value.items()})
            if container is tuple and isinstance(value, list):
                return tuple(_valid_value(element, item) for item in value)
        raise


def adapter(declared: Any) -> TypeAdapter[Any]:
    """What validates a value of that type; to make one takes longer than to use it."""
    known = _adapters.get(id(declared))
    if known is None:
        # A section brings its configuration along; for any other type it must be given.
        config = None if is_section(bare_type(declared)) else _STRICT
        known = _adapters[id(declared)] = (declared, TypeAdapter(declared, config=config))
    return known[1]


def is_section(bare: Any) -> TypeGuard[type[Section]]:
    """Whether a type is that of a table with keys of its own."""
    return isinstance(bare, type) and issubclass(bare, Section)


def bare_type(declared: Any) -> Any:
    """A type without its annotations and without ``| None``."""
    while True:
        if get_origin(declared) is Annotated:
            declared = get_args(declared)[0]
        elif get_origin(declared) in {Union, UnionType} and type(None) in get_args(declared):
            declared = next(arm for arm in get_args(declared) if arm is not type(None))
        else:
            return declared


def element_type(declared: Any) -> Any:
    """The type of the elements of an array or of the values of a table with free keys; None if neither."""
    bare = bare_type(declared)
    if get_origin(bare) is tuple:
        return get_args(bare)[0]
    if get_origin(bare) is dict and get_args(bare)[1] is not Any:
        return get_args(bare)[1]
    return None
