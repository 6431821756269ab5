"""What every table of a machine file has in common: strict values, no unknown keys, kinds of tables."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

from pydantic import BaseModel, ConfigDict, Field
from pydantic_core import PydanticCustomError, core_schema

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from pydantic import GetCoreSchemaHandler

Name = Annotated[str, Field(pattern=r"^[A-Za-z0-9_.-]+$", max_length=64)]
"""A name that can stand in an MQTT topic, a file name and a log line as it is."""

Positive = Annotated[float, Field(gt=0)]
NotNegative = Annotated[float, Field(ge=0)]
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

    if not TYPE_CHECKING:  # a type checker must go on refusing attributes that do not exist

        def __getattr__(self, name: str) -> Any:
            if name in type(self).model_fields:
                raise UnusableValueError(name)
            return super().__getattr__(name)


@dataclass(frozen=True)
class Kinds:
    """Annotation of a key whose table is of one of several kinds, told apart before it is validated.

    Only the errors of the kind that was meant are reported, not those of every kind tried in turn.

    Attributes:
        choose: picks the section for a table.
        sections: all of them, to recognise keys of another kind.
    """

    choose: Callable[[Mapping[str, Any]], type[Section]]
    sections: tuple[type[Section], ...]

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
            raise PydanticCustomError("section_type", "must be a table")
        return self.choose(value).model_validate(value)
