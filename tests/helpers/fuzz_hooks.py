"""What schemathesis cannot invent: a manifest whose quaternions are unit, and the images that it names.

Without these no drive would ever be created, and every later request would be answered with 404.
"""

from __future__ import annotations

import base64
import zlib
from typing import Any

import schemathesis
from schemathesis.core import NotSet
from schemathesis.generation import GenerationMode

from tests.helpers.tiny_drive import manifest, png

KEY = "Idempotency-Key"
_MANIFEST = manifest("fuzzed", frames=1)
_PATHS = tuple(image["file"] for image in _MANIFEST["frames"][0]["images"].values())


@schemathesis.serializer("application/offset+octet-stream")
def as_it_is(context: Any, value: Any) -> bytes:
    """The body of a tus client's PATCH."""
    return value if isinstance(value, bytes) else str(value).encode()


@schemathesis.hook
def before_call(context: Any, case: Any, kwargs: dict[str, Any]) -> None:
    """Make every second valid request to some routes one that can succeed; the others stay as they are."""
    if case.meta is None or case.meta.generation.mode is not GenerationMode.POSITIVE:
        return
    chance = zlib.crc32(repr((case.path_parameters, case.query, str(case.body))).encode())
    label = case.operation.label
    if label in ("POST /v1/drives", "POST /v1/webhooks"):
        # A replayed answer may name what was deleted since.
        case.headers = {name: value for name, value in (case.headers or {}).items() if name != KEY}
    # Of drives that were just created: few requests come so far that they can store a file, and none may by chance.
    stores = label == "PUT /v1/drives/{drive_id}/files/{path}" and str(case.path_parameters["drive_id"]).startswith(
        "drv_"
    )
    if chance % 2 and not stores:
        return
    if "/uploads" in label and "options" not in label.lower():
        case.headers = {**(case.headers or {}), "Tus-Resumable": "1.0.0"}
        if label == "POST /v1/drives/{drive_id}/uploads":
            path = base64.b64encode(_PATHS[chance // 2 % len(_PATHS)].encode()).decode()
            case.headers |= {"Upload-Length": str(1 + chance // 2 % 1000), "Upload-Metadata": f"path {path}"}
            case.headers.pop(KEY, None)
        elif label.startswith("PATCH"):
            case.headers |= {"Upload-Offset": "0"}
            case.headers.pop("Upload-Checksum", None)
    if label == "POST /v1/drives" and not isinstance(case.body, NotSet):
        case.body = _MANIFEST
    elif label == "PUT /v1/drives/{drive_id}/files/{path}":
        case.path_parameters["path"] = _PATHS[chance // 2 % len(_PATHS)]
        case.body = png(seed=str(chance // 2 % 3))
