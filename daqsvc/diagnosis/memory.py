"""What a detector remembers, taken out of it as plain values and put back into one that was just made.

A detector is objects of classes; what they refer to are numbers, texts, arrays and containers of such. These
are taken one by one, by where they are. What is no value (functions, threads, files, tables of the machine
file) stays what it is in the detector that they are put back into, which is made of the same machine file.
Nothing is pickled: to put values back runs no code but that of containers, so a file may bring them.
"""

from __future__ import annotations

import base64
import enum
import math
import sys
from collections import deque
from dataclasses import is_dataclass
from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias

import numpy as np
from pydantic import BaseModel

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

MOST_BYTES = 8_000_000
"""Of the arrays of one detector: one that has gathered more is not asked again and again."""
MOST_VALUES = 100_000
_DEEPEST = 60

Tree: TypeAlias = Any
"""What JSON can hold; arrays are numbers in a list beside it."""


class MemoryNotTakenError(Exception):
    """A detector remembers too much, or what cannot be stored."""


class MemoryNotFittingError(Exception):
    """What was remembered does not fit a detector, as it is of another version."""


class DetectorMemory(NamedTuple):
    """What a detector remembers.

    Attributes:
        tree: by kind of value, see `_Taker`.
        arrays: copies of its arrays.
    """

    tree: Tree
    arrays: list[NDArray[Any]]

    @property
    def nbytes(self) -> int:
        """Of its arrays."""
        return sum(array.nbytes for array in self.arrays)

    def document(self) -> dict[str, Any]:
        """The same as JSON can hold it."""
        arrays = [
            [array.dtype.str, list(array.shape), base64.b64encode(array.tobytes()).decode()]
            for array in self.arrays
        ]
        return {"tree": self.tree, "arrays": arrays}

    @classmethod
    def of(cls, document: dict[str, Any]) -> DetectorMemory:
        """The memory from what `document` has made.

        Raises:
            MemoryNotFittingError: it is none.
        """
        try:
            arrays = [_array(*one) for one in document["arrays"]]
            return cls(document["tree"], arrays)
        except (KeyError, TypeError, ValueError) as error:
            raise MemoryNotFittingError(f"it is none of daqsvc's: {error}") from None


def _array(dtype: str, shape: list[int], text: str) -> NDArray[Any]:
    kind = np.dtype(dtype)
    if kind.hasobject:
        raise ValueError("an array of objects")
    return np.frombuffer(base64.b64decode(text), kind).reshape(shape).copy()


def taken_memory(detector: object) -> DetectorMemory:
    """What a detector remembers now; from the thread that it computes in, or while it does not.

    Raises:
        MemoryNotTakenError: it is too much.
    """
    taker = _Taker(_packages(detector))
    return DetectorMemory(taker.tree_of(detector, 0), taker.arrays)


def put(detector: object, memory: DetectorMemory) -> None:
    """Have a detector that was just made of the same machine file remember that.

    Raises:
        MemoryNotFittingError: it cannot; it may then remember some of it, and is to be made again.
    """
    try:
        if _Putter(memory, _packages(detector)).value(memory.tree, detector) is not detector:
            raise MemoryNotFittingError("it is of a detector of another kind")
    except (KeyError, TypeError, ValueError, AttributeError, IndexError, RecursionError) as error:
        raise MemoryNotFittingError(f"{type(error).__name__}: {error}") from None


class _Taker:
    """Takes values, each object once: where it is met again its number stands.

    A value is itself where it is None, a truth, a whole number, a text or a finite float; anything else is a
    list that begins with its kind.
    """

    def __init__(self, packages: frozenset[str]) -> None:
        self.arrays: list[NDArray[Any]] = []
        self._packages = packages
        self._known: dict[int, tuple[int, object]] = {}
        self._bytes = 0

    def tree_of(self, value: object, depth: int) -> Tree:
        if value is None or type(value) in (bool, int, str, float):
            return value if not isinstance(value, float) or math.isfinite(value) else ["float", repr(value)]
        if isinstance(value, enum.Enum):
            return ["enum", _name(type(value)), value.name]
        if isinstance(value, np.generic | complex):
            return ["number" if isinstance(value, np.generic) else "complex", self._array(np.asarray(value))]
        if not _is_taken(value, self._packages):
            return ["kept"]
        if id(value) in self._known:
            return ["again", self._known[id(value)][0]]
        if depth > _DEEPEST or len(self._known) > MOST_VALUES:
            raise MemoryNotTakenError("what it remembers is nested too deep, or too much")
        number = len(self._known)
        self._known[id(value)] = (number, value)  # held, so that no other object gets its id
        return [*self._container(value, depth + 1), number]

    def _container(self, value: Any, depth: int) -> list[Any]:
        if isinstance(value, np.ndarray):
            return ["array", self._array(value)]
        if isinstance(value, bytes | bytearray):
            return ["bytes", base64.b64encode(value).decode()]
        if isinstance(value, dict):
            pairs = [[self.tree_of(k, depth), self.tree_of(v, depth)] for k, v in value.items()]
            return ["dict", pairs]
        if type(value) in _SEQUENCES or isinstance(value, tuple):
            items = [self.tree_of(one, depth) for one in value]
            kind: type[Any] = type(value)
            named = _SEQUENCES.get(kind) or _name(kind)
            return [named, items, value.maxlen] if isinstance(value, deque) else [named, items]
        fields = {name: self.tree_of(one, depth) for name, one in _attributes(value)}
        return ["object", _name(type(value)), fields]

    def _array(self, array: NDArray[Any]) -> int:
        if array.dtype.hasobject:
            raise MemoryNotTakenError("it has an array of objects")
        self._bytes += array.nbytes
        if self._bytes > MOST_BYTES:
            raise MemoryNotTakenError(f"it remembers more than {MOST_BYTES / 1e6:g} MB")
        self.arrays.append(np.array(array))
        return len(self.arrays) - 1


_BY_NAME: dict[str, type[Any]] = {one.__name__: one for one in (list, tuple, set, frozenset, deque)}
_SEQUENCES = {kind: name for name, kind in _BY_NAME.items()}
_MISSING = object()


class _Putter:
    """Puts values back into what is there, or makes new ones of them."""

    def __init__(self, memory: DetectorMemory, packages: frozenset[str]) -> None:
        self._arrays = memory.arrays
        self._packages = packages
        self._made: dict[int, object] = {}

    def value(self, tree: Tree, there: object) -> Any:  # noqa: PLR0911 - a line for each kind
        """The value of a tree.

        Args:
            tree: as of `_Taker`.
            there: what is at its place; `_MISSING` if nothing is.
        """
        if not isinstance(tree, list):
            return tree
        kind, *rest = tree
        match kind:
            case "float":
                return float(rest[0])
            case "enum":
                return self._class(rest[0], enum.Enum)[rest[1]]  # type: ignore[index]
            case "number" | "complex":
                return self._arrays[rest[0]].item() if kind == "complex" else self._arrays[rest[0]][()]
            case "kept":
                if there is _MISSING:
                    raise ValueError("a value is missing in its place")
                return there
            case "again":
                return self._made[rest[0]]
            case _:
                return self._container(kind, rest, there)

    def _container(self, kind: str, rest: list[Any], there: object) -> Any:
        number, content = rest[-1], rest[0]
        if kind in ("list", "deque", "dict") and isinstance(there, list | deque | dict):
            self._made[number] = there
        if kind == "array":
            made: Any = self._array(content, there)
        elif kind == "bytes":
            made = base64.b64decode(content)
        elif kind == "object":
            made = self._object(content, rest[1], number, there)
        elif kind == "dict":
            made = self._dict(content, there)
        elif kind in ("list", "deque"):
            made = self._list(kind, content, there, rest[1] if kind == "deque" else None)
        else:
            before = list(there) if isinstance(there, tuple) and len(there) == len(content) else []
            items = [self.value(one, before[k] if before else _MISSING) for k, one in enumerate(content)]
            made = _BY_NAME[kind](items) if kind in _BY_NAME else self._class(kind, tuple)._make(items)  # type: ignore[attr-defined]
        self._made[number] = made
        return made

    def _array(self, place: int, there: object) -> NDArray[Any]:
        array = self._arrays[place]
        fits = isinstance(there, np.ndarray) and (there.dtype, there.shape) == (array.dtype, array.shape)
        if fits and isinstance(there, np.ndarray) and there.flags.writeable:
            there[...] = array  # others may look at the same memory
            return there
        return array.copy()

    def _dict(self, pairs: list[Any], there: object) -> dict[Any, Any]:
        before = dict(there) if isinstance(there, dict) else {}
        made = there if isinstance(there, dict) else {}
        items = []
        for key_tree, value_tree in pairs:
            key = self.value(key_tree, _MISSING)
            items.append((key, self.value(value_tree, before.get(key, _MISSING))))
        made.clear()
        made.update(items)
        return made

    def _list(self, kind: str, trees: list[Any], there: object, longest: int | None) -> Any:
        fits = isinstance(there, _BY_NAME[kind])
        before = list(there) if fits else []  # type: ignore[call-overload]
        old = before if len(before) == len(trees) else [_MISSING] * len(trees)
        items = [self.value(tree, one) for tree, one in zip(trees, old, strict=True)]
        if not fits:
            return deque(items, longest) if kind == "deque" else items
        made: Any = there
        made.clear()
        made.extend(items)
        return made

    def _object(self, name: str, fields: dict[str, Tree], number: int, there: object) -> object:
        kind = self._class(name, object)
        before = there if type(there) is kind else _MISSING
        # What never changes may be shared with others, who are to keep theirs.
        is_shared = before is _MISSING or _is_frozen(kind)
        made = object.__new__(kind) if is_shared else before
        self._made[number] = made
        for field, tree in fields.items():
            object.__setattr__(made, field, self.value(tree, getattr(before, field, _MISSING)))
        return made

    def _class(self, name: str, base: type) -> type:
        """A class by its name, out of the modules that are loaded.

        Raises:
            ValueError: there is none, or none that may be made.
        """
        module, _, qualname = name.partition(":")
        resolved: Any = sys.modules.get(module) if _is_of(module, self._packages) else None
        for part in qualname.split("."):
            resolved = getattr(resolved, part, None)
        if not isinstance(resolved, type) or not issubclass(resolved, base) or _name(resolved) != name:
            raise ValueError(f"there is no class {name}")
        if base is object and (not _may_be_made(resolved) or issubclass(resolved, BaseModel)):
            raise ValueError(f"nothing of class {name} can be made")
        return resolved


def _is_taken(value: object, packages: frozenset[str]) -> bool:
    """Whether something is a value, or made of values; anything else stays in the detector."""
    kind = type(value)
    if kind in _SEQUENCES or isinstance(value, np.ndarray | dict | bytes | bytearray):
        return True
    if isinstance(value, BaseModel | type | BaseException) or callable(value):
        return False
    return _is_of(kind.__module__, packages) and (isinstance(value, tuple) or _may_be_made(kind))


def _is_frozen(kind: type) -> bool:
    return is_dataclass(kind) and bool(vars(kind)["__dataclass_params__"].frozen)


def _may_be_made(kind: type) -> bool:
    return getattr(kind, "__new__", None) is getattr(object, "__new__", None)


def _packages(detector: object) -> frozenset[str]:
    """The packages whose classes may be part of what a detector remembers: ours, and its own."""
    return frozenset({"daqsvc", type(detector).__module__.partition(".")[0]})


def _is_of(module: str, packages: frozenset[str]) -> bool:
    return module.partition(".")[0] in packages


def _attributes(value: object) -> Iterator[tuple[str, object]]:
    names = dict.fromkeys(getattr(value, "__dict__", {}))
    for kind in type(value).__mro__:
        slots = kind.__dict__.get("__slots__", ())
        names |= dict.fromkeys((slots,) if isinstance(slots, str) else slots)
    for name in names:
        if name not in {"__dict__", "__weakref__"} and hasattr(value, name):
            yield name, getattr(value, name)


def _name(kind: type) -> str:
    return f"{kind.__module__}:{kind.__qualname__}"
