"""Asking plugins: whatever a hook of one raises is one sentence that names it, and ends nothing else.

A hook is a public method or property of a `contract`, and of whatever is derived from it. Each call of one
is guarded, wherever it is called from, so a new hook needs no further guard.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from functools import cache, partial
from inspect import get_annotations, isfunction, signature
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple, TypeVar, get_args

from daqsvc.errors.code import with_code
from daqsvc.errors.machine_file import PLUGIN_FAILED
from daqsvc.settings.answers import meaning, misfit, short, shown
from daqsvc.settings.failures import BrokenContractError, failure, packages
from daqsvc.settings.problems import AssemblyError
from daqsvc.settings.section import UnusableValueError

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from daqsvc.settings.problems import KeyPath

ClassT = TypeVar("ClassT", bound="type[Hooks]")
CallableT = TypeVar("CallableT", bound="Callable[..., Any]")

_collected: ContextVar[list[PluginFailedError] | None] = ContextVar("collected", default=None)


class Hooks:
    """Base of all that plugins derive from; `contract` lists its methods and properties that are hooks."""

    __slots__ = ()
    __hooks__: ClassVar[frozenset[str]] = frozenset()
    __table__: ClassVar[str] = ""
    """Where it is in a machine file, if it has one table only."""

    if not TYPE_CHECKING:  # a type checker must go on refusing attributes that do not exist

        def __getattribute__(self, name: str) -> Any:
            get = super().__getattribute__
            if name not in type(self).__hooks__:
                return get(name)
            with _guarded(self, name):
                got = get(name)
                if _declared(self, name).is_property:
                    return _checked(self, name, got, "is")
                if not callable(got):
                    raise BrokenContractError(None, f"it is {short(got)}, not a method")
            return partial(_called, self, name, got)


class _Declared(NamedTuple):
    """What a contract states about a hook.

    Attributes:
        is_property: whether it is no method.
        may_raise: what it raises by intention.
        answer: what it returns, as it is annotated.
        wanted: that as a type.
        at: which of its arguments is a place in the machine file; None if none is.
    """

    is_property: bool
    may_raise: tuple[type[Exception], ...]
    answer: str
    wanted: Any
    at: int | None


class PluginFailedError(AssemblyError, UnusableValueError):
    """A hook of a plugin has raised something that it must not raise.

    Checks of a machine file take it as a value that is not known.

    Args:
        by: the plugin, or one of its tables.
        hook: the method or property that was asked.
        error: what it has raised.
        at: where in the machine file it was asked about; None if the hook does not get it.

    Attributes:
        failure: what has failed, in words for the author of the plugin, with the line of the plugin's file.
        file: the machine file, once it is known.
        table: what it was asked about, as people write it; empty if it is not known.
    """

    def __init__(self, by: Hooks, hook: str, error: BaseException, at: KeyPath | None = None) -> None:
        self.by, self.hook, self.at = by, hook, at
        self.failure = failure(error, type(by), hook)
        self.file: Path | None = None
        self.table = by.__table__
        super().__init__(self.failure.message, code=PLUGIN_FAILED)

    def __str__(self) -> str:
        return self.followed_by("")

    def followed_by(self, more: str) -> str:
        """What has failed and where, and ``more`` behind it."""
        places = "".join(f"{place}: " for place in (self.file, self.table) if place)
        return with_code(f"{places}{self.words}{more}", self.code)

    @property
    def words(self) -> str:
        """What has failed, and who can put it right."""
        return f"{self.failure.message}; {self.failure.or_remove(self.table)}"


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


def see_declared(kind: Any) -> None:
    """See that the attributes of a class are what its contract reports, and its hooks are methods.

    Raises:
        TypeError: something is not.
    """
    for contracted in (one for one in kind.__mro__ if "__hooks__" in vars(one)):
        for name, annotation in get_annotations(contracted).items():
            if name.startswith("_") or name in getattr(kind, "model_fields", ()) or not hasattr(kind, name):
                continue
            wanted, value = meaning(annotation, contracted.__module__), getattr(kind, name)
            if misfit(value, wanted):
                needed = shown(next(iter(get_args(wanted)), wanted) if "ClassVar" in annotation else wanted)
                raise TypeError(f"{name} of {kind.__qualname__} is {short(value)}, which must be {needed}")
        for name in sorted(contracted.__hooks__ & vars(contracted).keys()):
            if isfunction(vars(contracted)[name]) and not callable(getattr(kind, name)):
                value = getattr(kind, name)
                raise TypeError(f"{name} of {kind.__qualname__} is {short(value)}, which must be a method")


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
    place = _declared(by, name).at
    at = kwargs.get("at") if place is None or place >= len(args) else args[place]
    with _guarded(by, name, at):
        got = _checked(by, name, hook(*args, **kwargs), "returns")
    return _guarding(by, name, at, got, _declared(by, name).wanted)


def _checked(by: Hooks, name: str, got: Any, verb: str, wanted: Any = None) -> Any:
    """An answer as it is.

    Raises:
        BrokenContractError: it is not what the contract states.
    """
    answer = shown(wanted) if wanted else _declared(by, name).answer
    words = misfit(got, wanted or _declared(by, name).wanted)
    if words:
        closer = "" if words.startswith(f"{short(got)} is no ") else f": {words}"
        hook = getattr(type(by), name, None)
        raise BrokenContractError(hook, f"it {verb} {short(got)}, not {answer}{closer}")
    return got


def _guarding(by: Hooks, name: str, at: KeyPath | None, got: Any, wanted: Any) -> Any:
    """An answer that fails later, too, in the name of its hook: an iterator, or a list of some."""
    element = next(iter(get_args(wanted)), Any)
    if isinstance(got, Iterator):
        return _each(by, name, at, got, element)
    if isinstance(got, list | tuple) and any(isinstance(one, Iterator) for one in got):
        return [_guarding(by, name, at, one, element) for one in got]
    return got


def _each(by: Hooks, name: str, at: KeyPath | None, items: Iterator[Any], wanted: Any) -> Iterator[Any]:
    with _guarded(by, name, at):
        for one in items:
            yield _guarding(by, name, at, _checked(by, name, one, "yields", wanted), wanted)


@contextmanager
def _guarded(by: Hooks, name: str, at: KeyPath | None = None) -> Iterator[None]:
    try:
        yield
    except UnusableValueError:
        raise
    except (Exception, SystemExit) as error:
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
    return declared(kind, name)


@cache
def declared(kind: Any, name: str) -> _Declared:
    """As the first class from the top declares it."""
    first = next(one for one in reversed(kind.__mro__) if name in vars(one).get("__hooks__", ()))
    hook: Any = vars(first)[name]
    function: Any = hook.fget if isinstance(hook, property) else hook
    answer = str(function.__annotations__["return"])
    wanted = meaning(answer, first.__module__)
    arguments = list(signature(function).parameters)[1:]
    at = arguments.index("at") if "at" in arguments else None
    raises = getattr(function, "may_raise", ())
    return _Declared(isinstance(hook, property), raises, answer, wanted, at)
