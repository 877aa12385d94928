"""The secret that a request carries: an API key as a bearer token, or the cookie of the console's session."""

from __future__ import annotations

from urllib.parse import urlsplit

from fastapi import Request
from fastapi.security.utils import get_authorization_scheme_param

from service.domain.keys import is_session
from service.errors import ForeignOrigin

SESSION_COOKIE = "mrasfm_session"
_READING = ("GET", "HEAD", "OPTIONS")
_DEFAULT_PORTS = {"http": ":80", "https": ":443"}


def secret_of(request: Request) -> str | None:
    """The secret that says who calls; None where there is none. A bearer token is taken before the cookie.

    Raises
    ------
    ForeignOrigin
        For a write with the cookie that does not come from a page of this host. A bearer token needs no such proof,
        because browsers add none by themselves.
    """
    if "authorization" in request.headers:
        scheme, secret = get_authorization_scheme_param(request.headers["authorization"])
        return secret if scheme.lower() == "bearer" and secret and not is_session(secret) else None
    cookie = request.cookies.get(SESSION_COOKIE)
    if cookie is None or not is_session(cookie):
        return None
    if request.method not in _READING:
        _require_same_origin(request)
    return cookie


def _require_same_origin(request: Request) -> None:
    if not _is_same_origin(request):
        raise ForeignOrigin(
            "a request that changes something carries the console's cookie, and does not come from a page of this host",
            remedy="Use the console's own page or send an API key; a proxy in front of the service has to pass on "
            "Host as it came, with its port.",
        )


def _is_same_origin(request: Request) -> bool:
    # Scripts can set neither of the two headers. The first compares schemes as well and knows nothing of proxies, but
    # browsers leave it out where there is no TLS.
    site = request.headers.get("sec-fetch-site")
    if site is not None:
        return site == "same-origin"
    origin, host = urlsplit(request.headers.get("origin", "")), request.headers.get("host", "")
    port = _DEFAULT_PORTS.get(origin.scheme, "")
    return bool(origin.netloc) and origin.netloc.lower().removesuffix(port) == host.lower().removesuffix(port)


def is_encrypted(request: Request) -> bool:
    """Return whether the client's connection has TLS, as the first of the proxies in between says.

    Whoever claims it for a request of its own gets a cookie that its browser does not send back without TLS.
    """
    first = request.headers.get("x-forwarded-proto", "").partition(",")[0].strip().lower()
    return "https" in (request.url.scheme, first)
