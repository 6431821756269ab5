"""Whether JSON that a program has written is as the published schemas promise, and has nothing else."""

from __future__ import annotations

import copy
import functools
import json
from typing import TYPE_CHECKING, Any, TypeVar

from support.paths import ROOT

if TYPE_CHECKING:
    from jsonschema import Draft202012Validator

SCHEMAS = ROOT / "docs" / "schemas"
T = TypeVar("T")


@functools.cache
def closed(name: str) -> Draft202012Validator:
    """Of a published schema, and strict: an object has no keys but those of the schema."""
    # Importing it takes 1.5 s: whoever only collects tests does without.
    from jsonschema import Draft202012Validator

    schema = json.loads((SCHEMAS / f"{name.replace('/', '-').replace(' ', '-')}.json").read_text("utf-8"))
    return Draft202012Validator(_closed(copy.deepcopy(schema)))


def _closed(schema: Any) -> Any:
    if isinstance(schema, dict):
        if "properties" in schema:
            schema.setdefault("additionalProperties", False)
        for one in schema.values():
            _closed(one)
    elif isinstance(schema, list):
        for one in schema:
            _closed(one)
    return schema


def fits(name: str, document: T) -> T:
    """The same document, if it is of this format.

    Raises:
        AssertionError: it is not; states each place.
    """
    wrong = [f"{error.json_path}: {error.message[:300]}" for error in closed(name).iter_errors(document)]
    assert not wrong, f"{name}: {wrong}"
    return document
