"""Transfers of many objects at one time: outside a folder, each takes a round trip or several."""

from __future__ import annotations

import contextvars
from collections.abc import Callable, Generator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, as_completed
from contextlib import closing
from pathlib import Path
from typing import TypeVar

from service.storage.artifacts import Fetch, ObjectMissingError

FETCHES = 16
STORES = 4  # of files as large as a scene's points, of which parts are in memory

T = TypeVar("T")
R = TypeVar("R")


def at_one_time(count: int, step: Callable[[T], R], items: Sequence[T]) -> Generator[tuple[int, Future[R]]]:
    """Do a step for each item in some threads; the place of each item and its result, as they end.

    Closing the iterator, also by an error of who reads it, waits for those under way, and begins no other.
    """
    with ThreadPoolExecutor(count, thread_name_prefix="transfer") as pool:
        # In our context: the lines of a log name the job.
        places = {pool.submit(contextvars.copy_context().run, step, item): place for place, item in enumerate(items)}
        try:
            for ended in as_completed(places):
                yield places[ended], ended
        finally:
            pool.shutdown(wait=True, cancel_futures=True)


def fetch_each(
    fetch: Fetch,
    wanted: Sequence[tuple[str, Path]],
    *,
    progress: Callable[[int, int], None] = lambda done, total: None,
    on_missing: Callable[[int], None] | None = None,
) -> None:
    """Bring objects, by key, to files, whose folders are made.

    The first that fails ends it: those under way end before this raises, others do not begin.

    Parameters
    ----------
    fetch
        Brings one of them, in any thread.
    wanted
        Key and target of each.
    progress
        Called as progress(done, total) with each that is there, here and not in another thread.
    on_missing
        Called, here likewise, with the place in `wanted` of one that the store does not have, which then fails nothing.

    Raises
    ------
    Exception
        What `fetch` raises.
    """
    for folder in {target.parent for _, target in wanted}:
        folder.mkdir(parents=True, exist_ok=True, mode=0o700)
    with closing(at_one_time(FETCHES, lambda one: fetch(*one), wanted)) as fetches:
        for done, (place, brought) in enumerate(fetches, start=1):
            try:
                brought.result()
            except ObjectMissingError:
                if on_missing is None:
                    raise
                on_missing(place)
            progress(done, len(wanted))
