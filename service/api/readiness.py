"""Readiness of database and artifact store for writing, asked seldom and never by more than one thread."""

from __future__ import annotations

import time

import anyio
from sqlalchemy import delete, false

from service.api.context import Context
from service.database.connections import is_current
from service.database.tables import WorkerSeen
from service.errors import NotReady, ServiceError

_KEPT_S = 2.0  # many may ask, also without a key
_TIMEOUT_S = 8.0


class Readiness:
    """Answers `/readyz`.

    A store that does not answer must not take threads from requests that do not need it: the probe has one of its own.
    """

    def __init__(self, context: Context) -> None:
        self._context = context
        self._turn = anyio.Lock()
        self._thread = anyio.CapacityLimiter(1)
        self._kept_until_s = 0.0
        self._problem: ServiceError | None = None

    async def require(self) -> None:
        """Return where the service is ready.

        Raises
        ------
        ServiceError
            503, with what does not work.
        """
        async with self._turn:
            if time.monotonic() > self._kept_until_s:
                self._problem = await self._ask()
                self._kept_until_s = time.monotonic() + _KEPT_S
        if self._problem is not None:
            raise self._problem

    async def _ask(self) -> ServiceError | None:
        try:
            with anyio.fail_after(_TIMEOUT_S):
                return await anyio.to_thread.run_sync(self._probe, limiter=self._thread, abandon_on_cancel=True)
        except TimeoutError as error:
            return _not_ready("the database or the artifact store", error)

    def _probe(self) -> ServiceError | None:
        try:
            current = is_current(self._context.database)
            with self._context.database.write() as session:
                session.execute(delete(WorkerSeen).where(false()))  # a standby or a read-only file refuses it
        except Exception as error:
            return _not_ready("the database", error)
        if not current:
            return _not_ready("the database's schema", None)
        try:
            self._context.artifacts.require_writable()
        except Exception as error:
            return _not_ready("the artifact store", error)
        return None


def _not_ready(what: str, error: Exception | None) -> ServiceError:
    why = "is not the one this version expects" if error is None else f"cannot be used ({type(error).__name__})"
    return NotReady(
        f"{what} {why}",
        remedy="Run 'mrasfm migrate'." if error is None else "The operator has to look at its log and at its disk.",
        headers={"Retry-After": "5"},
    )
