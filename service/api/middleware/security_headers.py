"""Headers that tell browsers what they may do with an answer: every answer has them."""

from __future__ import annotations

import base64
import hashlib
import re

from starlette.datastructures import MutableHeaders
from starlette.types import ASGIApp, Message, Receive, Scope, Send

CONTENT_TYPE_OPTIONS = "X-Content-Type-Options"
CONTENT_SECURITY_POLICY = "Content-Security-Policy"
# Answers are data: no browser runs, loads or frames anything of them. An image or scene from outside may be anything.
DATA_POLICY = "default-src 'none'; frame-ancestors 'none'"

_INLINE_SCRIPT = re.compile(r"<script>(.*?)</script>", re.DOTALL)


class SecurityHeaders:
    """ASGI middleware. An answer that has a policy of its own keeps it."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Handle one request."""

        async def send_with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                add_security_headers(MutableHeaders(scope=message))
            await send(message)

        await self._app(scope, receive, send_with_headers)


def add_security_headers(headers: MutableHeaders) -> None:
    """Add what an answer does not have already."""
    headers.setdefault(CONTENT_TYPE_OPTIONS, "nosniff")
    headers.setdefault(CONTENT_SECURITY_POLICY, DATA_POLICY)


def page_policy(html: str) -> str:
    """The policy of a page that loads scripts and styles from this service, and asks this service.

    Its inline scripts are named by their SHA-256, so that no script that came into the page otherwise runs.

    Parameters
    ----------
    html
        The page.
    """
    hashes = [hashlib.sha256(script.encode()).digest() for script in _INLINE_SCRIPT.findall(html)]
    scripts = " ".join(["'self'", *(f"'sha256-{base64.b64encode(digest).decode()}'" for digest in hashes)])
    return "; ".join(
        [
            "default-src 'none'",
            f"script-src {scripts}",
            "style-src 'self'",
            "img-src 'self' data:",
            "connect-src 'self'",
            "base-uri 'none'",
            "form-action 'self'",
            "frame-ancestors 'none'",
        ]
    )
