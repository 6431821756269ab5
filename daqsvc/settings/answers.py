"""Whether answers and attributes of a plugin are what its contract declares, down to their elements."""

from __future__ import annotations

import ast
import inspect
import re
import sys
from collections.abc import Collection, Hashable, Iterable, Iterator, Mapping, Sequence
from dataclasses import is_dataclass
from functools import cache
from importlib import import_module
from numbers import Real
from types import NoneType, UnionType
from typing import Any, ClassVar, ForwardRef, Literal, TypeVar, Union, get_args, get_origin

from daqsvc.settings.failures import one_line

_LONGEST = 60
_ACCEPTED: Mapping[Any, type[Any]] = {
    # Whoever writes a list where one by one would do is understood.
    **dict.fromkeys((tuple, list, Sequence), Sequence),
    **dict.fromkeys((Iterable, Iterator), Iterable),
    Collection: Collection,
}


def meaning(annotation: str | ForwardRef, module: str) -> Any:
    """The type that an annotation of a module of ours represents; anything at all if that cannot be known."""
    text = annotation.__forward_arg__ if isinstance(annotation, ForwardRef) else annotation
    try:
        return eval(text, vars(sys.modules[module]), _Imported(module))  # noqa: S307 - our own text
    except NameError:  # there is no source to find it by
        return Any


def misfit(value: object, wanted: Any, *, inside: bool = False) -> str:
    """In what a value is not as it should be; empty if it is.

    What an iterator yields is not examined.

    Args:
        value: anything.
        wanted: a type, or an alias with its parameters.
        inside: whether it is in an object of ours: a tuple must be one, and nothing further in is examined.
    """
    origin, args = get_origin(wanted) or wanted or NoneType, get_args(wanted)
    if isinstance(origin, TypeVar) or origin is ClassVar:
        return misfit(value, args[0] if args else getattr(origin, "__bound__", Any), inside=inside)
    wrong = _no(value, wanted)
    if origin in {Union, UnionType}:
        misfits = {one: misfit(value, one, inside=inside) for one in args}
        closer = (words for one, words in misfits.items() if words != _no(value, one))
        return next(closer, wrong) if all(misfits.values()) else ""
    if getattr(origin, "_is_protocol", False):
        return _lacking(value, origin)
    if not _is_one(value, origin, args, inside=inside):
        return wrong
    parts = _parts(value, origin, args)
    if parts is None:
        return wrong
    words = (misfit(part, kind, inside=inside) for part, kind in parts)
    return next(filter(None, words), "") or ("" if inside else _fields(value, origin))


def shown(wanted: Any) -> str:
    """A type as an author writes it."""
    if wanted in {None, NoneType}:
        return "None"
    if isinstance(wanted, TypeVar):
        return shown(wanted.__bound__ or Any)
    if isinstance(wanted, type) and not get_args(wanted):
        return wanted.__name__
    if get_origin(wanted) in {Union, UnionType}:
        # Which of the two forms it has depends on who has asked for it before: typing remembers them as one.
        return " | ".join(shown(one) for one in get_args(wanted))
    return re.sub(r"~(\w+)", lambda _: "Section", re.sub(r"\b(?:\w+\.)+(\w+)", r"\1", str(wanted)))


def short(value: object) -> str:
    """A value as an author knows it, on one short line."""
    text = one_line(" ".join(re.sub(r" object at 0x[0-9a-f]+", "", repr(value)).split()))
    return text if len(text) <= _LONGEST else f"{text[: _LONGEST - 4]} ..."


def _no(value: object, wanted: Any) -> str:
    return f"{short(value)} is no {shown(wanted)}"


def _is_one(value: object, origin: Any, args: tuple[Any, ...], *, inside: bool) -> bool:
    """Whether a value is of a kind, whatever is in it."""
    if origin in {Any, Literal}:
        return origin is Any or value in args
    if origin is type:
        return isinstance(value, type) and issubclass(value, getattr(args[0], "__bound__", args[0]))
    if origin is Hashable:
        return _is_hashable(value)
    if origin in {int, float}:
        return isinstance(value, Real) and not isinstance(value, bool)
    return isinstance(value, tuple if inside and origin is tuple else _ACCEPTED.get(origin, origin))


def _is_hashable(value: object) -> bool:
    """Whether it can be a key: a tuple looks as if it could, whatever is in it."""
    try:
        hash(value)
    except Exception:  # noqa: BLE001 - a hash of a plugin's own may raise anything
        return False
    return True


def _parts(value: object, origin: Any, args: tuple[Any, ...]) -> Iterable[tuple[object, Any]] | None:
    """What a value consists of, with what each should be; None if the value itself is of another kind."""
    if not args or isinstance(value, Iterator) or origin not in {*_ACCEPTED, dict, Mapping}:
        return ()
    if isinstance(value, Mapping):
        whole = [pair for key, item in value.items() for pair in ((key, args[0]), (item, args[-1]))]
        return whole if origin in {dict, Mapping} else None
    if isinstance(value, str | bytes) or not isinstance(value, Iterable):
        return None
    if origin is not tuple or args[-1] is ...:
        return [(part, args[0]) for part in value]
    fixed = list(value)
    return zip(fixed, args, strict=True) if len(fixed) == len(args) else None


def _fields(value: object, kind: Any) -> str:
    """What is wrong with a field of a dataclass or a named tuple of ours."""
    if is_dataclass(kind) or hasattr(kind, "_fields"):
        for name, annotation in inspect.get_annotations(kind).items():
            words = misfit(getattr(value, name), meaning(annotation, kind.__module__), inside=True)
            if words:
                return f"in its {name}, {words}"
    return ""


def _lacking(value: object, protocol: Any) -> str:
    """What a value lacks of a protocol of ours, or has of another kind."""
    members = {name: note for name, note in inspect.get_annotations(protocol).items() if name[0] != "_"}
    for name, part in vars(protocol).items():
        if isinstance(part, property) or (inspect.isfunction(part) and name[0] != "_"):
            members[name] = part.fget.__annotations__["return"] if isinstance(part, property) else "object"
    for name, annotation in members.items():
        if not hasattr(value, name):
            own_init = "__init__" in vars(type(value)) and len(type(value).__mro__) > len((type, object))
            how = "call super().__init__() in its __init__, or set it" if own_init else "give it one"
            return f"{short(value)} lacks {name} of {protocol.__name__}; {how}"
        words = misfit(getattr(value, name), meaning(annotation, protocol.__module__), inside=True)
        if words:
            return f"in its {name}, {words}"
    return ""


class _Imported(dict[str, Any]):
    """What a module imports, if only for a type checker."""

    def __init__(self, module: str) -> None:
        super().__init__()
        self._module = module

    def __missing__(self, name: str) -> Any:
        return getattr(import_module(_imports(self._module)[name]), name)


@cache
def _imports(module: str) -> dict[str, str]:
    """By name, the module that it is imported from."""
    try:
        tree = ast.parse(inspect.getsource(sys.modules[module]))
    except OSError:
        return {}
    imports = [node for node in ast.walk(tree) if isinstance(node, ast.ImportFrom) and node.module]
    return {alias.name: str(node.module) for node in imports for alias in node.names}
