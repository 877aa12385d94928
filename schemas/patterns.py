"""Patterns of strings: the JSON Schema has the regular expression, a refusal says the same in words."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from pydantic import GetCoreSchemaHandler, GetJsonSchemaHandler
from pydantic.json_schema import JsonSchemaValue
from pydantic_core import CoreSchema, core_schema

MISMATCH = "string_not_of_pattern"  # type of the error


@dataclass(frozen=True)
class Pattern:
    """Annotation of a `str` that has to match a regular expression.

    Constraints of its length stand before it: `Annotated[str, Field(max_length=200), Pattern(...)]`.

    Parameters
    ----------
    expression
        As JSON Schema has it, with `^` and `$`.
    words
        The same for people, after "Input should be".
    """

    expression: str
    words: str

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        """Match in pydantic's core, as its own constraint does: a manifest has a million names."""
        matched = core_schema.str_schema(pattern=self.expression)
        worded = core_schema.custom_error_schema(
            matched, custom_error_type=MISMATCH, custom_error_message=f"Input should be {self.words}"
        )
        return core_schema.chain_schema([handler(source), worded])

    def __get_pydantic_json_schema__(self, schema: CoreSchema, handler: GetJsonSchemaHandler) -> JsonSchemaValue:
        """Add the expression to the schema of the string, which is the first step of the chain."""
        return {**handler(schema), "pattern": self.expression}
