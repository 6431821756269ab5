"""Asking plugins: whatever a hook of one raises is one sentence that names it, and ends nothing else.

A hook is a public method or property of a `contract`, and of whatever is derived from it: each call of one is
guarded, wherever it is called from, so that a new hook needs no guard of its own.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from functools import cache, partial
from inspect import isfunction, signature
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple, TypeVar

from daqsvc.settings.failures import mend_or_remove, packages, raised
from daqsvc.settings.problems import AssemblyError
from daqsvc.settings.section import UnusableValueError

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from daqsvc.settings.problems import KeyPath

ClassT = TypeVar("ClassT", bound="type[Hooks]")
CallableT = TypeVar("CallableT", bound="Callable[..., Any]")

_KINDS: Mapping[str, type[Any]] = {
    # Whoever writes a list where one by one would do is understood.
    **dict.fromkeys(("Iterator", "Iterable", "Collection", "Sequence", "tuple", "list"), Iterable),
    "Mapping": Mapping,
    "str": str,
}
"""What an answer must be at least, by the head of its annotation."""

_collected: ContextVar[list[PluginFailedError] | None] = ContextVar("collected", default=None)


class Hooks:
    """Base of all that plugins derive from; `contract` says which of its methods and properties are hooks."""

    __slots__ = ()
    __hooks__: ClassVar[frozenset[str]] = frozenset()
    __table__: ClassVar[str] = ""
    """Where it stands in a machine file, if it has one table only."""

    if not TYPE_CHECKING:  # a type checker must go on refusing attributes that do not exist

        def __getattribute__(self, name: str) -> Any:
            get = super().__getattribute__
            if name not in type(self).__hooks__:
                return get(name)
            with _guarded(self, name):
                got = get(name)
            return partial(_called, self, name, got) if callable(got) else got


class _Declared(NamedTuple):
    """What a contract says of a hook.

    Attributes:
        may_raise: what it raises by intention.
        answer: what it returns, as it is annotated.
        kind: what an answer is an instance of at least; None if that is not checked.
        may_be_none: whether it may have no answer.
        at: which of its arguments is a place in the machine file; None if none is.
    """

    may_raise: tuple[type[Exception], ...]
    answer: str
    kind: type[Any] | None
    may_be_none: bool
    at: int | None


class PluginFailedError(AssemblyError, UnusableValueError):
    """A hook of a plugin has raised something that it must not raise.

    Checks of a machine file take it as a value that is not known.

    Args:
        by: the plugin, or one of its tables.
        hook: the method or property that was asked.
        error: what it has raised.
        at: where in the machine file it was asked about; None if the hook is not told.

    Attributes:
        said: what has failed, in words for the author of the plugin, with the line of the plugin's file.
        file: the machine file, once it is known.
        table: what it was asked about, as people write it; empty if it is not known.
    """

    def __init__(self, by: Hooks, hook: str, error: Exception, at: KeyPath | None = None) -> None:
        self.by, self.hook, self.at = by, hook, at
        self.said = raised(error, type(by), hook)
        self.file: Path | None = None
        self.table = by.__table__
        super().__init__(self.said)

    def __str__(self) -> str:
        places = "".join(f"{place}: " for place in (self.file, self.table) if place)
        return f"{places}{self.words}"

    @property
    def words(self) -> str:
        """What has failed, and who can put it right."""
        return f"{self.said}; {mend_or_remove(type(self.by), self.table)}"


def contract(kind: ClassT) -> ClassT:
    """Make hooks of the public methods and properties of a class."""
    own = {name for name, part in vars(kind).items() if isfunction(part) or isinstance(part, property)}
    kind.__hooks__ |= {name for name in own if not name.startswith("_")}
    return kind


def may_raise(*errors: type[Exception]) -> Callable[[CallableT], CallableT]:
    """Let a hook raise something by intention: it is passed on as it is, and its words are for users."""

    def marked(hook: CallableT) -> CallableT:
        hook.__dict__["may_raise"] = errors
        return hook

    return marked


def brought_by(plugin: Hooks, package: str, table: str) -> None:
    """Remember the distribution that a plugin comes with, and its table in the machine file."""
    packages[type(plugin).__module__.partition(".")[0]] = package
    plugin.__dict__["__table__"] = table


@contextmanager
def collecting() -> Iterator[list[PluginFailedError]]:
    """Whatever hooks fail meanwhile, each once, also where somebody goes on without what they were asked."""
    collected: list[PluginFailedError] = []
    token = _collected.set(collected)
    try:
        yield collected
    finally:
        _collected.reset(token)


@contextmanager
def failing_in(file: Path, table: str = "") -> Iterator[None]:
    """Say of a hook that fails meanwhile where the machine file asks for it."""
    try:
        yield
    except PluginFailedError as failed:
        failed.file, failed.table = file, table or failed.table
        raise


def _called(by: Hooks, name: str, hook: Callable[..., Any], *args: Any, **kwargs: Any) -> Any:
    declared = _declared(by, name)
    at = kwargs.get("at") if declared.at is None or declared.at >= len(args) else args[declared.at]
    with _guarded(by, name, at):
        got = hook(*args, **kwargs)
        if got is None and not declared.may_be_none:
            raise TypeError(f"it returns None, not {declared.answer}")
        if got is not None and declared.kind is not None and not isinstance(got, declared.kind):
            raise TypeError(f"it returns {got!r:.80}, not {declared.answer}")
    return _each(by, name, at, got) if isinstance(got, Iterator) else got


def _each(by: Hooks, name: str, at: KeyPath | None, items: Iterator[Any]) -> Iterator[Any]:
    with _guarded(by, name, at):
        for one in items:
            yield _each(by, name, at, one) if isinstance(one, Iterator) else one


@contextmanager
def _guarded(by: Hooks, name: str, at: KeyPath | None = None) -> Iterator[None]:
    try:
        yield
    except UnusableValueError:
        raise
    except Exception as error:
        if isinstance(error, _declared(by, name).may_raise):
            raise
        failed = PluginFailedError(by, name, error, at)
        collected = _collected.get()
        if collected is not None and not any(
            one.by is by and (one.hook, one.at) == (name, at) for one in collected
        ):
            collected.append(failed)
        raise failed from error


def _declared(by: Hooks, name: str) -> _Declared:
    kind: Any = type(by)
    return _declared_of(kind, name)


@cache
def _declared_of(kind: type[Any], name: str) -> _Declared:
    """As the first class from the top declares it."""
    hook = next(vars(one)[name] for one in reversed(kind.__mro__) if name in vars(one).get("__hooks__", ()))
    if isinstance(hook, property):
        return _Declared((), "", None, may_be_none=True, at=None)
    answer = str(hook.__annotations__["return"])
    returned = set(answer.split(" | "))
    arguments = list(signature(hook).parameters)[1:]
    at = arguments.index("at") if "at" in arguments else None
    least = _KINDS.get(answer.partition("[")[0])
    return _Declared(getattr(hook, "may_raise", ()), answer, least, bool(returned & {"None", "Any"}), at)
