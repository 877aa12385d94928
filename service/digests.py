"""RFC 9530 `Content-Digest` and `Repr-Digest` fields: a dictionary of algorithms, of which we use SHA-256."""

from __future__ import annotations

import base64
import binascii
import re

from service.errors import MalformedDigest, ServiceError

_ALGORITHM = "sha-256"
# One member of RFC 8941's dictionary whose value is a byte sequence, with parameters that mean nothing here.
_MEMBER = re.compile(r"([a-z*][a-z0-9_.*-]*)=:([A-Za-z0-9+/]*={0,2}):(?:;[ ]*[a-z*][a-z0-9_.*-]*(?:=[^;,\s]+)?)*")
_DIGEST_BYTES = 32


def parse_digest(*fields: str) -> str | None:
    """SHA-256 of the lines of digest fields, in hexadecimal; None where there are none.

    Raises
    ------
    ServiceError
        400 `malformed-digest`, if a line does not follow RFC 9530, if several give different values, or if none gives
        SHA-256: to store the bytes unchecked is not what the sender has in mind.

    Examples
    --------
    >>> parse_digest("sha-256=:47DEQpj8HBSa+/TImW+5JCeuQeRkm5NMpJWZG3hSuFU=:")
    'e3b0c44298fc1c149afbf4c8996fb92427ae41e4649b934ca495991b7852b855'
    """
    found: set[str] = set()
    for part in ",".join(fields).split(",") if fields else ():
        member = _MEMBER.fullmatch(part.strip(" \t"))
        if member is None:
            raise _malformed(f"{part.strip()[:100]!r} is not of the form sha-256=:BASE64:")
        algorithm, value = member.groups()
        if algorithm == _ALGORITHM:
            found.add(_sha256(value))
    if len(found) > 1:
        raise _malformed("it gives sha-256 more than once, with different values")
    if fields and not found:
        raise _malformed("it does not give sha-256")
    return found.pop() if found else None


def format_digest(sha256: str) -> str:
    """A digest field's value from a hexadecimal SHA-256."""
    return f"{_ALGORITHM}=:{base64.b64encode(bytes.fromhex(sha256)).decode()}:"


def _sha256(value: str) -> str:
    unpadded = value.rstrip("=")  # RFC 8941 lets senders leave the padding out
    try:
        digest = base64.b64decode(unpadded + "=" * (-len(unpadded) % 4), validate=True)
    except binascii.Error:
        raise _malformed(f"{value[:100]!r} is not base64") from None
    if len(digest) != _DIGEST_BYTES:
        raise _malformed(f"a SHA-256 has {_DIGEST_BYTES} bytes, not {len(digest)}")
    return digest.hex()


def _malformed(why: str) -> ServiceError:
    return MalformedDigest(
        f"the digest field cannot be read: {why}",
        remedy="Send Content-Digest: sha-256=:BASE64: with the base64 of the 32 bytes, or leave it out.",
        headers={"Want-Content-Digest": f"{_ALGORITHM}=10"},
    )
