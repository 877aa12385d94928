"""HTTP that does not give up at the first trouble: retries with back-off, and answers that become errors.

Everything that a client asks may be repeated: GET and PUT by their nature, POST under its Idempotency-Key.
"""

from __future__ import annotations

import ipaddress
import os
import random
import socket
import ssl
import threading
import time
import weakref
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from http import HTTPStatus
from importlib.util import find_spec
from typing import Any
from urllib.request import getproxies, proxy_bypass

import httpx
from pydantic import ValidationError

from schemas.api.problems import MEDIA_TYPE, PROBLEM_TYPE, Problem
from service.client.errors import ApiError, ClientError, UnreachableError
from service.errors import RequestInFlight

CONNECT_TIMEOUT_S = 10.0
IO_TIMEOUT_S = 60.0
CHECK_TIMEOUT_S = 180.0  # an answer that waits for the check of a large manifest
FIRST_DELAY_S, MAX_DELAY_S = 0.2, 15.0
_SHOWN_CHARACTERS = 200
_PASSING = (
    HTTPStatus.REQUEST_TIMEOUT,  # the body came too slowly: this machine slept, or its network was gone for a while
    HTTPStatus.INTERNAL_SERVER_ERROR,
    HTTPStatus.BAD_GATEWAY,
    HTTPStatus.SERVICE_UNAVAILABLE,
    HTTPStatus.GATEWAY_TIMEOUT,
)

Body = Callable[[], Iterator[bytes]]  # called for every try, so that each begins with the first byte


class TroubleError(ClientError):
    """Something that may pass: `cause` is raised once the retry budget is spent."""

    def __init__(self, cause: ClientError, retry_after_s: float | None = None) -> None:
        super().__init__(str(cause))
        self.cause = cause
        self.retry_after_s = retry_after_s


class RetryBudget:
    """Waits longer and longer between tries, and ends after `limit_s` without success."""

    def __init__(self, limit_s: Callable[[], float], closing: threading.Event) -> None:
        self._limit_s = limit_s
        self._closing = closing
        self.renew()

    def renew(self) -> None:
        """Something worked: the whole budget is back."""
        self._began_s = time.monotonic()
        self._delay_s = FIRST_DELAY_S

    def pause(self, trouble: TroubleError) -> None:
        """Wait before the next try.

        Raises
        ------
        ClientError
            The trouble's cause, where the budget is spent.
        """
        delay_s = self._delay_s * random.uniform(0.5, 1.0)  # many clients shall not come back at the same moment
        if trouble.retry_after_s is not None:
            delay_s = max(delay_s, trouble.retry_after_s)
        if time.monotonic() + delay_s > self._began_s + self._limit_s() or self._closing.wait(delay_s):
            raise trouble.cause from trouble
        self._delay_s = min(2 * self._delay_s, MAX_DELAY_S)


class Transport:
    """Requests to one service under one key. May be used by many threads.

    Parameters
    ----------
    url
        Of the service, with or without a path before `/v1`.
    key
        Sent as bearer token, and never shown.
    connections
        At one time.
    retry_s
        For how long one request is tried again.
    first_retry_s
        The same, as long as nothing has ever answered: then the URL is probably wrong.

    Raises
    ------
    ClientError
        Where the URL or the key cannot be one, or the environment names a proxy or certificates that cannot be used.
    """

    def __init__(
        self, url: str, key: str, *, connections: int, retry_s: float, first_retry_s: float | None = None
    ) -> None:
        self.url = checked_url(url)
        self._answered = False
        self._retry_s = retry_s
        self._first_retry_s = retry_s if first_retry_s is None else first_retry_s
        self.closing = threading.Event()
        self._connections = _Connections()
        self._http = httpx.Client(
            base_url=self.url,
            verify=_certificates(self.url),
            headers={"Authorization": f"Bearer {_checked_key(key)}", "Accept-Encoding": "identity"},
            timeout=httpx.Timeout(IO_TIMEOUT_S, connect=CONNECT_TIMEOUT_S, pool=None),
            limits=httpx.Limits(max_connections=connections, max_keepalive_connections=connections),
            follow_redirects=False,  # the key is for this service, not for whom it names
            proxy=_proxy_of(httpx.URL(self.url)),
            trust_env=False,  # httpx would open all proxies of the environment, also those that are not for this URL
        )

    def stop(self) -> None:
        """End what waits, sends or receives in other threads, now."""
        self.closing.set()
        self._connections.end()

    def close(self) -> None:
        """End everything, and give its resources back."""
        self.stop()
        self._http.close()

    def retry_budget(self) -> RetryBudget:
        """Budget of a series of tries of one thing."""
        return RetryBudget(lambda: self._retry_s if self._answered else self._first_retry_s, self.closing)

    def request(
        self,
        method: str,
        path: str,
        *,
        headers: Mapping[str, str] | None = None,
        body: Body | None = None,
        timeout_s: float = IO_TIMEOUT_S,
    ) -> httpx.Response:
        """The answer to a request, with its body read; tried until it succeeds or cannot.

        Raises
        ------
        ApiError
            The service refused it.
        UnreachableError
            Nothing answered.
        """
        budget = self.retry_budget()
        while True:
            try:
                with self.open(method, path, headers=headers, body=body, read_timeout_s=timeout_s) as response:
                    response.read()
                    return response
            except TroubleError as trouble:
                budget.pause(trouble)

    @contextmanager
    def open(
        self,
        method: str,
        path: str,
        *,
        headers: Mapping[str, str] | None = None,
        body: Body | None = None,
        read_timeout_s: float = IO_TIMEOUT_S,
    ) -> Iterator[httpx.Response]:
        """One try of a request, whose answer is read piece by piece.

        Raises
        ------
        ApiError
            The service refused it.
        ClientError
            `path` is not one.
        TroubleError
            It may work another time; also where the connection breaks while the answer is read.
        """
        if not path.startswith("/") or path.startswith("//"):
            # httpx would take an address for the whole target, and send the key there.
            raise ClientError(f"{path!r} is not a path of {self.url}. Nothing was sent to it.")
        timeout = httpx.Timeout(IO_TIMEOUT_S, connect=CONNECT_TIMEOUT_S, read=read_timeout_s, pool=None)
        content = None if body is None else body()
        try:
            with self._http.stream(
                method,
                path,
                headers=headers,
                content=content,
                timeout=timeout,
                extensions={"trace": self._connections.note},
            ) as got:
                self._answered = True
                if got.status_code >= HTTPStatus.MULTIPLE_CHOICES and got.status_code != HTTPStatus.NOT_MODIFIED:
                    got.read()
                    raise _refusal(got)
                yield got
        except (httpx.RequestError, RuntimeError) as error:
            if self.closing.is_set():  # a closed client of httpx raises RuntimeError
                raise UnreachableError(f"{method} {path} was given up: the client was stopped") from error
            if isinstance(error, httpx.TransportError):
                raise TroubleError(self._unreachable(error)) from error
            if isinstance(error, httpx.RequestError):
                raise UnreachableError(f"{method} {path} was given up: {error}") from error
            raise

    def _unreachable(self, error: httpx.TransportError) -> UnreachableError:
        what = str(error).rstrip(".") or type(error).__name__
        return UnreachableError(
            f"{self.url} cannot be reached: {what}. Check the URL, and that the service runs; then give the same "
            "command again."
        )


class _Connections:
    """The sockets of a client, so that another thread can end what one waits for: closing does not wake it up."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._sockets: weakref.WeakSet[socket.socket] = weakref.WeakSet()
        self._ended = False

    def note(self, event: str, info: Mapping[str, Any]) -> None:
        """A step of a request, as httpx tells its extension `trace`."""
        if event.endswith((".connect_tcp.complete", ".start_tls.complete")):
            with self._lock:
                self._sockets.add(info["return_value"].get_extra_info("socket"))
            if self._ended:
                self.end()

    def end(self) -> None:
        """End all connections, and those that are still being made."""
        self._ended = True
        with self._lock:
            for connection in self._sockets:
                with suppress(OSError):
                    # A TLS socket's own shutdown would let what another thread sends now pass unencrypted.
                    socket.socket.shutdown(connection, socket.SHUT_RDWR)


def checked_url(url: str) -> str:
    """A service's URL without a slash at its end.

    Raises
    ------
    ClientError
        Where it is not http or https, holds a key, a query or a fragment, or ends with /v1.
    """
    try:
        parsed = httpx.URL(url.strip())
    except (httpx.InvalidURL, ValueError) as error:
        raise ClientError(f"{url!r} is not a URL: {error}. Give one such as https://maps.example.org.") from None
    if parsed.userinfo:
        raise ClientError("the URL holds a user or password. Give the URL alone, and the key in MRASFM_API_KEY.")
    if parsed.scheme not in ("http", "https") or not parsed.host or parsed.query or parsed.fragment:
        raise ClientError(f"{url!r} is not the URL of a service. Give one such as https://maps.example.org.")
    root = str(parsed).rstrip("/")
    if parsed.path.rstrip("/").endswith("/v1"):
        raise ClientError(f"the URL {url!r} ends with /v1, which every request adds. Give {root.removesuffix('/v1')}.")
    return root


def is_loopback(host: str) -> bool:
    """Return whether requests to the host stay on this machine."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def _checked_key(key: str) -> str:
    key = key.strip()
    if not key or not key.isascii() or not key.isprintable() or " " in key:
        raise ClientError("the API key is empty or holds characters that no key has. Give what 'keys create' printed.")
    return key


def _refusal(response: httpx.Response) -> ApiError | TroubleError:
    given = _given_problem(response)
    error = ApiError(given or _made_up_problem(response), status=response.status_code)
    retry_after_s = _seconds(response.headers.get("retry-after"))
    passing = response.status_code in _PASSING or error.code == RequestInFlight.code
    # Our own 429 without a time is a quota, and no waiting helps; another's comes from a proxy's rate limit.
    passing |= response.status_code == HTTPStatus.TOO_MANY_REQUESTS and (given is None or retry_after_s is not None)
    return TroubleError(error, retry_after_s) if passing else error


def _given_problem(response: httpx.Response) -> Problem | None:
    if not response.headers.get("content-type", "").startswith(MEDIA_TYPE):
        return None
    try:
        problem = Problem.model_validate_json(response.content)
    except ValidationError:
        return None
    return problem if problem.type.startswith(PROBLEM_TYPE) else None


def _made_up_problem(response: httpx.Response) -> Problem:
    """A problem for an answer that is not the service's own: of a proxy, or of something else under this URL."""
    asked = f"{response.request.method} {response.request.url}"
    remedy = "Check that the URL is that of an MRASfM service; what answers here is something else, or before it."
    if response.is_redirect:
        remedy = f"Give the address that it leads to: {response.headers.get('location', '')}."
    text = " ".join(response.text.split())[:_SHOWN_CHARACTERS]
    detail = f"{asked} was answered with {response.status_code} {response.reason_phrase}: {text}".rstrip(": ")
    return Problem(type="about:blank", title="Unexpected answer", detail=detail, remedy=remedy)


def unexpected(response: httpx.Response, what: str) -> ApiError:
    """An answer that says success and is not what the service answers."""
    problem = _made_up_problem(response).model_copy(
        update={"detail": f"{response.request.method} {response.request.url}: the answer is not {what}"}
    )
    return ApiError(problem, status=response.status_code)


def _seconds(retry_after: str | None) -> float | None:
    """`Retry-After` in seconds; its other form, a date, is not worth trusting two clocks for."""
    return float(retry_after) if retry_after is not None and retry_after.strip().isdecimal() else None


def _certificates(url: str) -> ssl.SSLContext:
    """Certificates that a server's is verified with; where there is no TLS, none are loaded, which takes 50 ms.

    A context without certificates would refuse every server.

    Raises
    ------
    ClientError
        Where those that the environment names cannot be read.
    """
    if httpx.URL(url).scheme == "http":
        return ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    try:
        return httpx.create_ssl_context()
    except OSError as error:  # an error of TLS is one
        named = " or ".join(name for name in ("SSL_CERT_FILE", "SSL_CERT_DIR") if os.environ.get(name))
        raise ClientError(
            f"the certificates of {named} cannot be read: {error.strerror or error}. Correct the variable or unset it."
        ) from error


def _proxy_of(url: httpx.URL) -> httpx.Proxy | None:
    """The proxy that the environment names for a URL; none reaches this machine's loopback.

    Raises
    ------
    ClientError
        Where it cannot be used. The message names the variable and not what it holds: that may be a password.
    """
    if is_loopback(url.host) or proxy_bypass(url.netloc.decode("ascii")):
        return None
    proxies = getproxies()
    kind = next((kind for kind in (url.scheme, "all") if proxies.get(kind)), None)
    if kind is None:
        return None
    address = proxies[kind]
    try:
        proxy = httpx.Proxy(address if "://" in address else f"http://{address}")
        if not proxy.url.host:
            raise ValueError("it names no host")
    except (ValueError, httpx.InvalidURL):
        problem, remedy = "is no http://, https:// or socks5:// URL", "Correct it"
    else:
        if not proxy.url.scheme.startswith("socks") or find_spec("socksio") is not None:
            return proxy
        problem, remedy = "speaks SOCKS, for which the package socksio is missing", "Install it, give an HTTP proxy"
    raise ClientError(
        f"the proxy of {kind.upper()}_PROXY {problem}. {remedy}, or name {url.host} in NO_PROXY if it is reached "
        "without a proxy."
    )
