"""Common parts of resources."""

from __future__ import annotations

from collections.abc import Iterator
from datetime import datetime
from typing import Annotated, Any, Generic, Literal, TypeVar, get_args

from pydantic import BaseModel, ConfigDict, Field
from pydantic.config import JsonDict

from schemas.notebook_table import notebook_table
from schemas.patterns import Pattern

# Examples tell of the same things throughout: an answer shows what the request before it made.
EXAMPLE_DRIVE = "drv_1f0c2a9d3b7e4f5a6c8d9e0f1a2b3c"
EXAMPLE_OTHER_DRIVE = "drv_77aa0c2a9d3b7e4f5a6c8d9e0f1a2b"
EXAMPLE_JOB = "job_1f0c2a9d3b7e4f5a6c8d9e0f1a2b3c"
EXAMPLE_SCENE = "scn_1f0c2a9d3b7e4f5a6c8d9e0f1a2b3c"
EXAMPLE_MAP = "map_1f0c2a9d3b7e4f5a6c8d9e0f1a2b3c"
EXAMPLE_EXPORT = "exp_1f0c2a9d3b7e4f5a6c8d9e0f1a2b3c"
EXAMPLE_SHA256 = "ab" * 32

Id = Annotated[str, Pattern(r"^[a-z0-9_]{1,40}$", words="an id: 1 to 40 lower-case letters (a-z), digits and _")]
Sha256 = Annotated[str, Pattern(r"^[0-9a-f]{64}$", words="64 hexadecimal digits in lower case")]
Item = TypeVar("Item")


class Resource(BaseModel):
    """Root of what the API answers."""

    model_config = ConfigDict(frozen=True)

    def _repr_html_(self) -> str:
        """Jupyter's picture of a resource: its fields; of lists and of what holds more, how much there is."""
        return notebook_table(type(self).__name__.removesuffix("Resource"), dict(_named_values(self)))


class ArtifactResource(Resource):
    """One file of a scene or of a map's version."""

    path: str = Field(description="with its folders")
    size_bytes: int
    sha256: Sha256 = Field(description="in hexadecimal")
    media_type: str = Field(description="what the download says as Content-Type")
    url: str = Field(description="where to get it, relative to the server")


def _named_values(resource: BaseModel, within: str = "") -> Iterator[tuple[str, object]]:
    for name in type(resource).model_fields:
        value = getattr(resource, name)
        if isinstance(value, BaseModel):
            yield from _named_values(value, f"{within}{name}.")
        elif isinstance(value, list | dict):
            yield f"{within}{name}", f"{len(value)} entries"
        elif value is not None:
            yield f"{within}{name}", value


class RequestBody(BaseModel):
    """Root of what the API is asked: unknown fields and not-a-number are refused."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


def example_of(model: type[BaseModel]) -> dict[str, Any]:
    """The first example of a model.

    Raises
    ------
    TypeError
        Where it has none.
    """
    extra = model.model_config.get("json_schema_extra")
    examples = extra.get("examples") if isinstance(extra, dict) else None
    if not isinstance(examples, list) or not isinstance(examples[0], dict):
        raise TypeError(f"{model.__name__} has no example")
    return dict(examples[0])


def _describe_page(schema: JsonDict, page: type[Any]) -> None:
    (item,) = get_args(page.model_fields["items"].annotation)
    shown = example_of(item)
    if "files" in shown:
        shown["files"] = []  # lists leave them out
    schema["description"] = Page.__doc__
    schema["examples"] = [{"items": [shown], "next": None}]


class Page(Resource, Generic[Item]):
    """Part of a list, newest first unless said otherwise."""

    model_config = ConfigDict(json_schema_extra=_describe_page)

    items: list[Item] = Field(description="at most `limit`")
    next: str | None = Field(None, description="give it as `cursor` to go on; null at the end")


class Finding(Resource):
    """Finding of the check of a drive."""

    model_config = ConfigDict(
        json_schema_extra={
            "examples": [
                {
                    "severity": "warning",
                    "code": "gnss-jump",
                    "what": "GNSS jumps at gnss.samples.412: 38 m in 0.1 s at the first",
                    "remedy": "Nothing needs to be done for single outliers, which are rejected; for many, check the "
                    "receiver's data or give larger sigmas.",
                    "count": 1,
                }
            ]
        }
    )

    severity: Literal["error", "warning"] = Field(description="error stops a reconstruction, warning does not")
    code: str = Field(description="stable; in lower case with dashes")
    what: str = Field(description="one sentence that names the file or field")
    remedy: str = Field(description="one sentence that says what to do")
    count: int = Field(1, description="number of defects: over one where it stands for others like one before it")


class Times(Resource):
    """Times at which a resource came and goes."""

    created_at: datetime = Field(description="in UTC, as all times")
    expires_at: datetime | None = Field(None, description="when it will be deleted; null: never by itself")
