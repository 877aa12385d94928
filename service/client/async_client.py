"""The client for programs with an event loop.

Its methods are those of `Client`, awaited: each runs in a thread of the client's own, with the same retries. Lists are
asynchronous iterators. What takes longer runs with `call`:

>>> async with AsyncClient("https://maps.example.org", key) as client:  # doctest: +SKIP
...     sent = await client.call(upload_drive, DriveFolder.read(Path("my-drive")))
...     job = await client.call(watch_job, (await client.reconstruct(sent.drive_id)).id)
...     await client.call(download, await client.scene(job.scene_id), Path("my-scene"))
...     async for scene in client.scenes():
...         print(scene.id)

A task that is cancelled does not wait for its thread: what was sent may have its effect. `stop` ends all threads.
"""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import partial, wraps
from itertools import islice
from typing import Concatenate, ParamSpec, TypeVar

from service.client.api import FIRST_RETRY_S, RETRY_S, Client

P = ParamSpec("P")
R = TypeVar("R")

_AT_ONCE = 100  # items of a list that one visit of a thread brings


def _awaited(
    method: Callable[Concatenate[Client, P], R],
) -> Callable[Concatenate[AsyncClient, P], Awaitable[R]]:
    @wraps(method)
    async def run(self: AsyncClient, /, *args: P.args, **kwargs: P.kwargs) -> R:
        return await self.call(method, *args, **kwargs)

    return run


def _iterated(
    method: Callable[Concatenate[Client, P], Iterator[R]],
) -> Callable[Concatenate[AsyncClient, P], AsyncIterator[R]]:
    @wraps(method)
    async def run(self: AsyncClient, /, *args: P.args, **kwargs: P.kwargs) -> AsyncIterator[R]:
        items = method(self.client, *args, **kwargs)
        while brought := await self.call(lambda _: list(islice(items, _AT_ONCE))):
            for item in brought:
                yield item

    return run


class AsyncClient:
    """A service, under one API key, for one event loop; see `Client` for arguments and errors."""

    def __init__(
        self,
        url: str,
        key: str,
        *,
        connections: int = 8,
        retry_s: float = RETRY_S,
        first_retry_s: float = FIRST_RETRY_S,
    ) -> None:
        self.client = Client(url, key, connections=connections, retry_s=retry_s, first_retry_s=first_retry_s)
        self._threads = ThreadPoolExecutor(connections, thread_name_prefix="mrasfm-client")

    async def __aenter__(self) -> AsyncClient:
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.close()

    async def call(self, function: Callable[Concatenate[Client, P], R], *args: P.args, **kwargs: P.kwargs) -> R:
        """The result of a function whose first argument is a `Client`, in a thread: `upload_drive`, `download`."""
        work = partial(function, self.client, *args, **kwargs)
        return await asyncio.get_running_loop().run_in_executor(self._threads, work)

    def stop(self) -> None:
        """End what waits, sends or receives, now. The client cannot be used again."""
        self.client.stop()

    async def close(self) -> None:
        """End what waits, and close all connections."""
        self.client.stop()
        await asyncio.to_thread(self._threads.shutdown, True)
        self.client.close()

    status = _awaited(Client.status)
    create_drive = _awaited(Client.create_drive)
    drive = _awaited(Client.drive)
    drives = _iterated(Client.drives)
    delete_drive = _awaited(Client.delete_drive)
    declare = _awaited(Client.declare)
    put_file = _awaited(Client.put_file)
    commit = _awaited(Client.commit)
    preflight = _awaited(Client.preflight)
    reconstruct = _awaited(Client.reconstruct)
    job = _awaited(Client.job)
    jobs = _iterated(Client.jobs)
    cancel_job = _awaited(Client.cancel_job)
    retry_job = _awaited(Client.retry_job)
    scene = _awaited(Client.scene)
    scenes = _iterated(Client.scenes)
    delete_scene = _awaited(Client.delete_scene)
    aggregate = _awaited(Client.aggregate)
    map = _awaited(Client.map)
    maps = _iterated(Client.maps)
    delete_map = _awaited(Client.delete_map)
    map_version = _awaited(Client.map_version)
    map_versions = _iterated(Client.map_versions)
    show_map_version = _awaited(Client.show_map_version)
    delete_map_version = _awaited(Client.delete_map_version)
    export_scene = _awaited(Client.export_scene)
    export_map = _awaited(Client.export_map)
    export = _awaited(Client.export)
    exports = _iterated(Client.exports)
    delete_export = _awaited(Client.delete_export)
    create_webhook = _awaited(Client.create_webhook)
    webhooks = _iterated(Client.webhooks)
    rotate_webhook = _awaited(Client.rotate_webhook)
    delete_webhook = _awaited(Client.delete_webhook)
    deliveries = _iterated(Client.deliveries)
    retry_delivery = _awaited(Client.retry_delivery)
    read_file = _awaited(Client.read_file)
