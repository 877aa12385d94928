"""Names that nothing has: the one that is meant is the one that is spelt most like it."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from difflib import get_close_matches
from typing import Any, get_args

from pydantic import BaseModel

from schemas.findings import listed

MAX_COMPARED = 80  # characters of a name: the comparison takes the square of their number
MAX_LISTED = 12


def similar_name(name: str, known: Collection[str]) -> str | None:
    """The known name that is spelt most like one that is not known, in capitals or not; None where none is like it."""
    by_lower = {one.lower(): one for one in known}
    found = get_close_matches(name[:MAX_COMPARED].lower(), by_lower, n=1)
    return by_lower[found[0]] if found else None


def correction_of(document: type[BaseModel], place: Sequence[str | int]) -> str:
    """Text on what to write in the place of a field that a document does not have, as the end of a sentence.

    Parameters
    ----------
    document
        Model of the whole document.
    place
        Keys and indices that lead to the field, its own name last, as pydantic's errors have them.

    Returns
    -------
    str
        "; did you mean NAME?", where a section of the document has a field of this very name, or else the place has one
        that is spelt like it; otherwise the fields that the place has.
    """
    models = [document]
    for step in place[:-1]:
        models = [inner for model in models for inner in _models_at(model, step)]
    name, fields = str(place[-1]), list(dict.fromkeys(field for model in models for field in model.model_fields))
    meant = next(_sections_with(document, name), None) or similar_name(name, fields)
    return f"; did you mean {meant}?" if meant else f"; allowed here: {listed(fields, MAX_LISTED)}"


def _models_at(model: type[BaseModel], step: str | int) -> Iterator[type[BaseModel]]:
    """Models of a field's values; of what is no field, an index or a key within one, the model itself."""
    field = model.model_fields.get(str(step))
    if field is None:
        yield model
    else:
        yield from _models_in(field.annotation)


def _models_in(annotation: Any) -> Iterator[type[BaseModel]]:
    """Models that an annotation names, in lists, dictionaries and unions."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation
    for argument in get_args(annotation):
        yield from _models_in(argument)


def _sections_with(document: type[BaseModel], name: str) -> Iterator[str]:
    """A document's fields of this name, at its top and in its sections, as a reader finds them."""
    if name in document.model_fields:
        yield f"{name} at the top of the document"
    for section, field in document.model_fields.items():
        annotation = field.annotation
        if isinstance(annotation, type) and issubclass(annotation, BaseModel) and name in annotation.model_fields:
            yield f"{section}.{name}"
