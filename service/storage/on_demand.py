"""A folder of bounded size, whose files come from the artifact store as they are asked for.

A drive of ten minutes has tens of gigabytes of images, of which a stage reads each once, mostly in the order of the
path. Others that follow are brought ahead of who asks, as each takes a round trip or several.
"""

from __future__ import annotations

import contextvars
import threading
from collections import OrderedDict, deque
from collections.abc import Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from dataclasses import dataclass
from pathlib import Path
from typing import Self

from service.storage.artifacts import Fetch
from service.storage.transfers import FETCHES

_AHEAD = 2 * FETCHES  # files that are brought before they are asked for
_FEWEST = 4 * _AHEAD  # that stay, whatever their size: one that was asked for is read before so many others come
_ENDS_WITHIN_S = 2.0  # a store that hangs holds up neither a stop nor what follows


@dataclass(frozen=True)
class RemoteFile:
    """A file in the artifact store."""

    key: str
    size_bytes: int


class OnDemandFolder:
    """Files of a drive under their names, as many as fit; those that were asked for longest ago go first.

    Parameters
    ----------
    folder
        It need not exist.
    files
        All files, by their names relative to the folder, in the order in which most are asked for.
    fetch
        Brings one of them, in any thread.
    room_bytes
        That the files take at one time, but for some dozens of very large ones.
    """

    def __init__(self, folder: Path, files: Mapping[str, RemoteFile], *, fetch: Fetch, room_bytes: int) -> None:
        self._folder, self._remote, self._fetch, self._room_bytes = folder, files, fetch, room_bytes
        self._order: Sequence[str] = list(files)
        self._place = {name: place for place, name in enumerate(self._order)}
        self._recent: deque[int] = deque(maxlen=_AHEAD)  # places of the files that were asked for last
        self._files: OrderedDict[str, Future[None]] = OrderedDict()  # those here, or on their way
        self._bytes = 0
        self._error: Exception | None = None
        self._lock = threading.Lock()
        self._pool = ThreadPoolExecutor(FETCHES, thread_name_prefix="on-demand")
        for parent in {(folder / name).parent for name in files}:
            parent.mkdir(parents=True, exist_ok=True, mode=0o700)

    def bring(self, name: str) -> None:
        """Return when a file is in the folder, where it stays until many others were asked for.

        Raises
        ------
        KeyError
            Where the drive has no such file.
        Exception
            What `fetch` raises.
        """
        with self._lock:
            brought = self._begin(name)
            self._files.move_to_end(name)
            for other in self._expected(self._place[name]):
                self._begin(other)
        try:
            brought.result()
        except Exception as error:
            if not brought.cancelled():
                self._error = self._error or error
            raise

    def raise_error(self) -> None:
        """Raise the first error of a file that was asked for and did not come, if there was one."""
        if self._error is not None:
            raise self._error

    def _expected(self, place: int) -> Sequence[str]:
        """The next files in either direction, as many as were asked for lately on the way to this place.

        Who goes along the files soon has many brought ahead; who takes samples, few that nobody reads.
        """
        steps = [place - other for other in self._recent]
        self._recent.append(place)
        ahead, behind = (sum(0 < step * sign <= _AHEAD for step in steps) for sign in (1, -1))
        return [*self._order[place + 1 : place + 1 + ahead], *self._order[max(0, place - behind) : place][::-1]]

    def _begin(self, name: str) -> Future[None]:
        if name not in self._files:
            self._make_room(self._remote[name].size_bytes)
            self._bytes += self._remote[name].size_bytes
            # In the context of who asks: the lines of a log name the job.
            self._files[name] = self._pool.submit(contextvars.copy_context().run, self._bring, name)
        return self._files[name]

    def _make_room(self, size_bytes: int) -> None:
        while self._bytes + size_bytes > self._room_bytes and len(self._files) > _FEWEST:
            oldest = next((name for name, future in self._files.items() if future.done()), None)
            if oldest is None:
                return
            self._forget(oldest)
            (self._folder / oldest).unlink(missing_ok=True)

    def _bring(self, name: str) -> None:
        try:
            self._fetch(self._remote[name].key, self._folder / name)
        except Exception:
            with self._lock:
                self._forget(name)  # it may be asked for again
            raise
        with self._lock:
            self._files.move_to_end(name)  # who waits for it reads it now, however many others were asked for meanwhile

    def _forget(self, name: str) -> None:
        del self._files[name]
        self._bytes -= self._remote[name].size_bytes

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._pool.shutdown(wait=False, cancel_futures=True)
        with self._lock:
            under_way = [future for future in self._files.values() if not future.cancelled()]
        wait(under_way, _ENDS_WITHIN_S)
