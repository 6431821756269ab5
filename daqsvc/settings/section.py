"""What every table of a machine file has in common: strict values, no unknown keys, kinds of tables."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, NoReturn, Self

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ModelWrapValidatorHandler, model_validator
from pydantic_core import PydanticCustomError, core_schema

from daqsvc.errors.machine_file import BAD_TEXT, PLUGIN_FAILED, WRONG_TYPE
from daqsvc.settings.failures import failure

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from pydantic import GetCoreSchemaHandler, GetJsonSchemaHandler


class InSchema:
    """A mark on a type: what a validator of ours asks of a value, as the JSON Schema states it.

    Args:
        keywords: of JSON Schema (draft 7). ``words`` is for the reference: its ``$comment``.
    """

    def __init__(self, words: str = "", **keywords: Any) -> None:
        self._keywords = {**keywords, **({"$comment": words} if words else {})}

    def __get_pydantic_json_schema__(
        self, core: core_schema.CoreSchema, handler: GetJsonSchemaHandler
    ) -> dict[str, Any]:
        """The schema of the type, with the keywords."""
        return {**handler(core), **self._keywords}


@dataclass(frozen=True, slots=True)
class Unit:
    """A mark on the type of a key: the unit of its value, where the name of the key cannot state it."""

    name: str


NOT_ZERO = InSchema("not 0", **{"not": {"const": 0}})

Name = Annotated[str, Field(pattern=r"^\.*[A-Za-z0-9_-][A-Za-z0-9_.-]*$", max_length=64)]
"""A name that can be used in an MQTT topic, a file name and a log line as it is; not ``.`` or ``..``."""


def _printable(text: str) -> str:
    if not text.isprintable():
        raise PydanticCustomError(
            "text_not_printable",
            "holds what cannot be printed",
            {"remedy": "take out line ends, tabs and control characters", "code": BAD_TEXT},
        )
    return text


Line = Annotated[str, Field(max_length=256), AfterValidator(_printable)]
"""A text on one line of a terminal."""
Text = Annotated[str, Field(min_length=1, max_length=256), AfterValidator(_printable)]
"""A line that is not empty."""
ClientId = Annotated[str, Field(min_length=1, max_length=128), AfterValidator(_printable)]

# Every number has bounds on both sides: what no machine, sensor or device can have is a slip of the pen.
MOST_CHANNELS = 1024
"""Of a stream; a frame or a line has room for fewer."""
MOST = 1e12
"""The largest size of a value in whichever unit a channel or a sensor has."""

Quantity = Annotated[float, Field(ge=-MOST, le=MOST)]
"""A value in the unit of a channel, a sensor or a signal."""

Volts = Annotated[float, Field(ge=-1000, le=1000)]
DelayS = Annotated[float, Field(ge=0, le=604_800)]
"""Up to a week."""
WaitMs = Annotated[float, Field(ge=1, le=60_000)]
PositionUm = Annotated[float, Field(ge=-100_000, le=100_000)]
"""Of a shaft in its bearing, or a part of that."""
Nats = Annotated[float, Field(ge=0, le=1_000_000)]
AngleDeg = Annotated[float, Field(ge=-360, le=360)]
DampingRatio = Annotated[float, Field(ge=0, le=2)]


class UnusableValueError(Exception):
    """A check asked for a value that the file does not hold in valid form (that is reported already).

    Deliberately no `AttributeError`, which a property of a section would turn into something else.
    """


class Section(BaseModel):
    """A table of the machine file: immutable, strictly typed, unknown keys refused.

    A section that was put together from the valid part of a faulty table raises
    `UnusableValueError` when one of the other values is asked for.
    """

    model_config = ConfigDict(
        frozen=True, extra="forbid", strict=True, allow_inf_nan=False, hide_input_in_errors=True
    )

    kind: ClassVar[str] = ""
    """What this table is called in messages, where one key can hold tables of several kinds."""

    @model_validator(mode="wrap")
    @classmethod
    def _whatever_validators_do(cls, value: Any, validate: ModelWrapValidatorHandler[Self]) -> Self:
        """Have a validator of a plugin that fails reported at its table; other tables are unaffected."""
        try:
            return validate(value)
        except (ValueError, AssertionError):  # it is not valid, which validators report this way
            raise
        except Exception as error:
            message, remedy, _ = failure(error, cls, "a validator")
            raise PydanticCustomError(
                "validator_failed", "{message}", {"message": message, "remedy": remedy, "code": PLUGIN_FAILED}
            ) from error

    if not TYPE_CHECKING:  # a type checker must go on refusing attributes that do not exist

        def __getattr__(self, name: str) -> Any:
            if name in type(self).model_fields:
                raise UnusableValueError(name)
            return super().__getattr__(name)


class FrozenTables(dict[str, Any]):
    """Tables by name that cannot be changed: every plugin is given the same machine file."""

    def _refuse(self, *_: object, **__: object) -> NoReturn:
        raise TypeError("a machine file is not to be changed: whoever needs another one makes a copy")

    __setitem__ = __delitem__ = __ior__ = clear = pop = popitem = setdefault = update = _refuse

    def __reduce__(self) -> tuple[type[FrozenTables], tuple[dict[str, Any]]]:
        return FrozenTables, (dict(self),)


@dataclass(frozen=True)
class NamesDetector:
    """Annotation of a key that names a detector: the example of it in a message is one that is installed."""


@dataclass(frozen=True)
class Kinds:
    """Annotation of a key whose table is of one of several kinds, distinguished before it is validated.

    Only the errors of the kind that was meant are reported, not those of every kind tried in turn.

    Attributes:
        choose: picks the section for a table.
        listed: all of them, to recognise keys of another kind; a function where plugins bring them.
    """

    choose: Callable[[Mapping[str, Any]], type[Section]]
    listed: tuple[type[Section], ...] | Callable[[], tuple[type[Section], ...]]

    @property
    def sections(self) -> tuple[type[Section], ...]:
        """All the kinds."""
        return self.listed if isinstance(self.listed, tuple) else self.listed()

    def __get_pydantic_core_schema__(
        self, _source: object, _handler: GetCoreSchemaHandler
    ) -> core_schema.CoreSchema:
        """Validate with `validate` in place of pydantic's own union."""
        return core_schema.no_info_plain_validator_function(self.validate)

    def validate(self, value: object) -> Section:
        """The section for ``value``.

        Raises:
            PydanticCustomError: ``value`` is not a table.
            ValidationError: the table is not a valid one of its kind.
        """
        if isinstance(value, Section):
            return value
        if not isinstance(value, dict):
            raise PydanticCustomError("section_type", "must be a table", {"code": WRONG_TYPE})
        return self.choose(value).model_validate(value)
