"""Places that requests of several projects share, so that no project keeps the others out."""

from __future__ import annotations

import math
import sys
from collections import Counter
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from typing import TypeVar

import anyio
import anyio.to_thread

from service.errors import Busy, ServiceError, TooManyLargeBodies

Result = TypeVar("Result")

_RETRY_AFTER_S = 10


@dataclass(eq=False)
class _Waiter:
    project_id: str
    granted: anyio.Event = field(default_factory=anyio.Event)


class FairPlaces:
    """Places of one process, for its event loop alone.

    A free place goes to the waiting project that holds the fewest, among these to the one that got its last place the
    longest ago, and within a project to the request that waits the longest.

    Parameters
    ----------
    places
        That are held at one time.
    per_project
        That one project holds at one time; where it is fewer than all, there is always one for another project.
    waiting_per_project
        Requests of one project that wait; each further one is refused at once, for each takes memory.
    """

    def __init__(self, places: int, *, per_project: int, waiting_per_project: int) -> None:
        self._free = places
        self._per_project = per_project
        self._waiting_per_project = waiting_per_project
        self._held: Counter[str] = Counter()
        self._waiters: list[_Waiter] = []
        self._grants = 0
        self._last_grant: dict[str, int] = {}  # of projects that hold a place or wait for one

    @property
    def held(self) -> int:
        """Number of held places."""
        return self._held.total()

    @property
    def waiting(self) -> int:
        """Number of waiting requests."""
        return len(self._waiters)

    @asynccontextmanager
    async def place(self, project_id: str, *, within_s: float) -> AsyncIterator[None]:
        """A place, held until the block ends.

        Parameters
        ----------
        within_s
            The longest wait for it.

        Raises
        ------
        ServiceError
            429 where the project itself holds its share for all this time, or too many of its requests wait already;
            503 where other projects are in the way.
        """
        await self._take(project_id, within_s)
        try:
            yield
        finally:
            self._give_back(project_id)

    async def _take(self, project_id: str, within_s: float) -> None:
        if sum(waiter.project_id == project_id for waiter in self._waiters) >= self._waiting_per_project:
            raise _too_many(within_s)
        waiter = _Waiter(project_id)
        self._waiters.append(waiter)
        self._grant_free()
        try:
            with anyio.fail_after(within_s):
                await waiter.granted.wait()
        except BaseException as error:
            own_fault = self._held[project_id] >= self._per_project
            self._withdraw(waiter)
            if isinstance(error, TimeoutError):
                raise (_too_many(within_s) if own_fault else _busy(within_s)) from None
            raise

    def _withdraw(self, waiter: _Waiter) -> None:
        if waiter.granted.is_set():  # just as it gave up
            self._give_back(waiter.project_id)
        else:
            self._waiters.remove(waiter)
            self._forget(waiter.project_id)

    def _give_back(self, project_id: str) -> None:
        self._free += 1
        self._held[project_id] -= 1
        self._grant_free()
        self._forget(project_id)

    def _grant_free(self) -> None:
        while self._free:
            entitled = [waiter for waiter in self._waiters if self._held[waiter.project_id] < self._per_project]
            if not entitled:
                return
            waiter = min(entitled, key=self._rank)  # of equal ones the first
            self._waiters.remove(waiter)
            self._free -= 1
            self._held[waiter.project_id] += 1
            self._grants += 1
            self._last_grant[waiter.project_id] = self._grants
            waiter.granted.set()

    def _rank(self, waiter: _Waiter) -> tuple[int, int]:
        return self._held[waiter.project_id], self._last_grant.get(waiter.project_id, 0)

    def _forget(self, project_id: str) -> None:
        """Keep nothing of projects that are gone."""
        if not self._held[project_id]:
            del self._held[project_id]
            if all(waiter.project_id != project_id for waiter in self._waiters):
                self._last_grant.pop(project_id, None)


class FairThreads:
    """Threads of their own that projects share, for what takes minutes: those of all other requests are left alone.

    Who waits for one waits as long as it takes: what came with the request is here already.
    """

    def __init__(self, threads: int) -> None:
        self.places = FairPlaces(threads, per_project=threads, waiting_per_project=sys.maxsize)
        self._limiter = anyio.CapacityLimiter(threads)

    async def run(self, project_id: str, function: Callable[..., Result], *given: object) -> Result:
        """The function's result; it runs in a thread, once it is the project's turn."""
        async with self.places.place(project_id, within_s=math.inf):
            return await anyio.to_thread.run_sync(function, *given, limiter=self._limiter)


def _too_many(within_s: float) -> ServiceError:
    return TooManyLargeBodies(
        f"the project's other large requests took all of its places for {within_s:g} s, or too many wait already",
        remedy="Send large manifests one after another; repeat this one in some seconds.",
        headers={"Retry-After": str(_RETRY_AFTER_S), "Connection": "close"},
    )


def _busy(within_s: float) -> ServiceError:
    return Busy(
        f"large requests of other projects took all places for {within_s:g} s; this one had no effect",
        remedy="Repeat it in some seconds.",
        headers={"Retry-After": str(_RETRY_AFTER_S), "Connection": "close"},
    )
