"""Places that several projects share: who gets the next one, and how long one waits."""

from __future__ import annotations

import threading
from collections.abc import Callable, Coroutine
from typing import Any

import anyio
import pytest
from anyio.abc import TaskGroup

from service.api.http.fair_places import FairPlaces, FairThreads
from service.errors import ServiceError

PLENTY_S = 60.0


class Crowd:
    """Requests that hold places until they are told to go."""

    def __init__(self, places: FairPlaces, tasks: TaskGroup) -> None:
        self.places = places
        self.served: list[str] = []
        self._tasks = tasks
        self._leave: dict[str, anyio.Event] = {}

    async def come(self, *names: str) -> None:
        """Requests `PROJECT` plus a digit, one after another."""
        for name in names:
            self._leave[name] = anyio.Event()
            self._tasks.start_soon(self._hold, name)
            await anyio.wait_all_tasks_blocked()

    async def leave(self, name: str) -> None:
        self._leave[name].set()
        await anyio.wait_all_tasks_blocked()

    async def _hold(self, name: str) -> None:
        async with self.places.place(name[:-1], within_s=PLENTY_S):
            self.served.append(name)
            await self._leave[name].wait()


def in_a_crowd(test: Callable[[Crowd], Coroutine[Any, Any, None]], places: FairPlaces) -> None:
    async def run() -> None:
        async with anyio.create_task_group() as tasks:
            await test(Crowd(places, tasks))
            tasks.cancel_scope.cancel()

    anyio.run(run)
    assert (places.held, places.waiting) == (0, 0), "whoever is cancelled leaves nothing behind"


def refusal_of(places: FairPlaces, project_id: str, within_s: float) -> Callable[[], Coroutine[Any, Any, ServiceError]]:
    async def ask() -> ServiceError:
        with pytest.raises(ServiceError) as refused:
            async with places.place(project_id, within_s=within_s):
                pass
        return refused.value

    return ask


def test_no_project_holds_more_than_its_share() -> None:
    async def test(crowd: Crowd) -> None:
        await crowd.come("a1", "a2", "a3", "b1", "b2", "b3")
        assert crowd.served == ["a1", "a2", "b1", "b2"]
        await crowd.leave("a1")
        assert crowd.served[4:] == ["a3"]

    in_a_crowd(test, FairPlaces(4, per_project=2, waiting_per_project=9))


def test_a_project_that_holds_fewer_goes_first() -> None:
    async def test(crowd: Crowd) -> None:
        await crowd.come("a1", "a2", "b1", "c1", "b2", "d1")
        assert crowd.served == ["a1", "a2", "b1", "c1"]
        await crowd.leave("a1")
        assert crowd.served[4:] == ["d1"], "it holds none; of the earlier ones b holds one"
        await crowd.leave("c1")
        assert crowd.served[5:] == ["b2"]

    in_a_crowd(test, FairPlaces(4, per_project=2, waiting_per_project=9))


def test_projects_take_turns() -> None:
    async def test(crowd: Crowd) -> None:
        await crowd.come("a1", "a2", "a3", "b1", "b2")
        for name in ("a1", "b1", "a2", "b2"):
            await crowd.leave(name)
        assert crowd.served == ["a1", "b1", "a2", "b2", "a3"]

    in_a_crowd(test, FairPlaces(1, per_project=1, waiting_per_project=9))


def test_waiting_ends_and_says_why() -> None:
    async def test(crowd: Crowd) -> None:
        await crowd.come("a1", "a2")
        own = await refusal_of(crowd.places, "a", 0.01)()
        assert (own.status, own.code) == (429, "too-many-large-bodies")
        await crowd.come("b1")
        others = await refusal_of(crowd.places, "c", 0.01)()
        assert (others.status, others.code) == (503, "busy")
        for error in (own, others):
            assert int(error.headers["Retry-After"]) > 0
        await crowd.leave("a1")
        await crowd.come("c1")
        assert crowd.served[-1] == "c1"

    in_a_crowd(test, FairPlaces(3, per_project=2, waiting_per_project=9))


def test_not_too_many_of_a_project_wait() -> None:
    async def test(crowd: Crowd) -> None:
        await crowd.come("a1", "a2", "a3")
        refused = await refusal_of(crowd.places, "a", PLENTY_S)()
        assert refused.status == 429
        await crowd.come("b1")
        assert crowd.places.waiting == 3, "another project's may wait"

    in_a_crowd(test, FairPlaces(1, per_project=1, waiting_per_project=2))


def test_a_thread_goes_to_the_project_that_comes_behind_many_of_another() -> None:
    threads, go_on, served = FairThreads(1), threading.Event(), list[str]()

    def serve(name: str) -> str:
        assert go_on.wait(PLENTY_S)
        served.append(name)
        if name == "a2":
            raise ValueError(name)
        return name

    async def ask(name: str) -> None:
        try:
            assert await threads.run(name[0], serve, name) == name
        except ValueError:
            assert name == "a2"

    async def run() -> None:
        async with anyio.create_task_group() as tasks:
            for name in ("a1", "a2", "a3", "b1", "b2"):
                tasks.start_soon(ask, name)
                await anyio.wait_all_tasks_blocked()
            go_on.set()

    anyio.run(run)
    assert served == ["a1", "b1", "a2", "b2", "a3"]
    assert (threads.places.held, threads.places.waiting) == (0, 0)
