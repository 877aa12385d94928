"""The console's session: begin it with a key, show it, end it."""

from __future__ import annotations

from fastapi import APIRouter, Request, Response

from schemas.api.session import SessionResource
from service.api.context import Context
from service.api.credentials import SESSION_COOKIE, is_encrypted, secret_of
from service.api.dependencies import CallerDep, ContextDep, moment
from service.api.http.responses import gives, problems
from service.domain import sessions
from service.domain.keys import is_session
from service.domain.sessions import Opened
from service.errors import Unauthorized

router = APIRouter(prefix="/v1/session", tags=["session"])


@router.post(
    "",
    status_code=201,
    response_model=SessionResource,
    summary="Log in",
    responses={**gives(201, "The session has begun", "Set-Cookie"), **problems(401, 403)},
)
def begin_session(caller: CallerDep, context: ContextDep, request: Request, response: Response) -> SessionResource:
    """Exchange a key, sent as a bearer token, for a cookie that opens the same for 12 hours.

    Scripts cannot read the cookie (`HttpOnly`) and other sites' pages cannot send it (`SameSite=Strict`). A request
    that changes something and carries the cookie has to come from a page of this host: `Sec-Fetch-Site: same-origin`,
    or an `Origin` equal to its `Host`. The session ends with its key.
    """
    secret = secret_of(request) or ""
    with context.database.write() as session:
        opened = None if is_session(secret) else sessions.opened_by(session, secret)
        if opened is None:
            raise _no_key()
        cookie, expires_us = sessions.begin(session, opened.key.id)
        shown = _shown(context, Opened(key=opened.key, project=opened.project, expires_us=expires_us))
    _set_cookie(response, request, cookie, max_age_s=sessions.KEPT_S)
    return shown


@router.get("", summary="Show the session", responses={**gives(200, "The caller"), **problems(401)})
def get_session(caller: CallerDep, context: ContextDep, request: Request) -> SessionResource:
    """The project and the key that the request's cookie or key stands for."""
    return _shown(context, _opened(context, request))


@router.delete(
    "", status_code=204, summary="Log out", responses={**gives(204, "It has ended", "Set-Cookie"), **problems(401, 403)}
)
def end_session(caller: CallerDep, context: ContextDep, request: Request, response: Response) -> None:
    """End the session of the cookie and delete the cookie. A key is not revoked by this."""
    secret = secret_of(request) or ""
    if is_session(secret):
        with context.database.write() as session:
            sessions.end(session, secret)
        context.keys.forget(secret)
    _set_cookie(response, request, "", max_age_s=0)


def _opened(context: Context, request: Request) -> Opened:
    with context.database.read() as session:
        opened = sessions.opened_by(session, secret_of(request) or "")
    if opened is None:  # it ended a moment ago
        raise _no_key()
    return opened


def _no_key() -> Unauthorized:
    return Unauthorized(
        "the request carries no API key that is valid",
        remedy="Send 'Authorization: Bearer KEY' with a key made by 'mrasfm keys create'.",
        headers={"WWW-Authenticate": 'Bearer realm="mrasfm"'},
    )


def _set_cookie(response: Response, request: Request, value: str, *, max_age_s: int) -> None:
    response.set_cookie(
        SESSION_COOKIE,
        value,
        max_age=max_age_s,
        path="/",
        secure=is_encrypted(request),
        httponly=True,
        samesite="strict",
    )


def _shown(context: Context, opened: Opened) -> SessionResource:
    project, key = opened.project, opened.key
    return SessionResource.model_validate(
        {
            "project": project.name,
            "key_id": key.id,
            "key_name": key.name,
            "key_created_at": moment(key.created_us),
            "session_expires_at": moment(opened.expires_us),
            "used_bytes": project.used_bytes,
            "max_bytes": project.max_bytes,
            "max_active_jobs": project.max_active_jobs,
            "max_drives": project.max_drives,
            "console_tiles": context.settings.console_tiles,
        }
    )
