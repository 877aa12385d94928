"""A careful client: it repeats every request until it is answered, and says at any time what it has under way."""

from __future__ import annotations

import random
import threading
import time
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import httpx

TIMEOUT_S = 60.0
PATIENCE_S = 900.0  # of one request; longer than anything may be stuck
FIRST_PAUSE_S, LONGEST_PAUSE_S = 0.1, 2.0
PIECE_BYTES = 4096
_PASSING = frozenset({408, 423, 429, 500, 502, 503, 504})
_IN_FLIGHT = "request-in-flight"


class RefusedError(Exception):
    """The service refused what it should have taken; the message has its problem."""


class GaveUpError(Exception):
    """The request was not answered within the client's patience, or the run is over."""


@dataclass
class Try:
    """One request on its way. Times are those of `time.time`; written by its client, read by others."""

    kind: str
    began_s: float
    port: int | None = None  # of the client's end of the connection, once there is one
    ended_s: float | None = None
    outcome: str = ""  # a status or `broken`, once it has ended

    def was_under_way(self, at_s: float) -> bool:
        """Whether it had begun and was neither answered nor broken at that time."""
        return self.began_s <= at_s and (self.ended_s is None or at_s < self.ended_s)


class Board:
    """The requests of all clients: those under way, and how the others ended."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._under_way: list[Try] = []
        self._outcomes: Counter[str] = Counter()
        self._held: dict[int, float] = {}
        self._longest_held_s = 0.0

    def begin(self, kind: str, port: int | None) -> Try:
        """Note a request that is being sent."""
        begun = Try(kind, time.time(), port)
        with self._lock:
            self._under_way.append(begun)
        return begun

    def end(self, ended: Try, outcome: str) -> None:
        """Note that it was answered, or that its connection broke."""
        with self._lock:
            ended.outcome, ended.ended_s = outcome, time.time()
            self._under_way.remove(ended)
            self._outcomes[f"{ended.kind} {outcome}"] += 1

    def under_way(self, kinds: Sequence[str]) -> list[Try]:
        """Requests of these kinds that are connected."""
        with self._lock:
            return [asked for asked in self._under_way if asked.kind in kinds and asked.port is not None]

    def hold(self, client: int) -> None:
        """A client was told that its request is in flight already."""
        with self._lock:
            self._held.setdefault(client, time.monotonic())

    def release(self, client: int) -> None:
        """The client was told something else."""
        with self._lock:
            since_s = self._held.pop(client, None)
            if since_s is not None:
                self._longest_held_s = max(self._longest_held_s, time.monotonic() - since_s)

    @property
    def held(self) -> int:
        """Clients that are told, again and again, that their request is in flight."""
        with self._lock:
            return len(self._held)

    @property
    def longest_held_s(self) -> float:
        """For how long one was told so, those included that still are."""
        with self._lock:
            waiting = [time.monotonic() - since_s for since_s in self._held.values()]
            return max([self._longest_held_s, *waiting])

    @property
    def outcomes(self) -> Mapping[str, int]:
        """How often each kind of request ended how."""
        with self._lock:
            return dict(sorted(self._outcomes.items()))


class CarefulClient:
    """One connection of one thread.

    Parameters
    ----------
    over
        Set when the run ends: nothing is repeated any more.
    """

    def __init__(self, url: str, key: str, board: Board, over: threading.Event, rng: random.Random) -> None:
        self._board, self._over, self._rng = board, over, rng
        self._port: int | None = None
        self._asked: Try | None = None
        self._http = httpx.Client(
            base_url=url,
            headers={"Authorization": f"Bearer {key}", "Accept-Encoding": "identity"},
            timeout=TIMEOUT_S,
            limits=httpx.Limits(max_connections=1, max_keepalive_connections=1),
            trust_env=False,
        )

    def close(self) -> None:
        """Close the connection."""
        self._http.close()

    def ask(
        self,
        kind: str,
        method: str,
        path: str,
        *,
        headers: Mapping[str, str] | None = None,
        json: Any = None,
        data: bytes | None = None,
        seconds: float = 0.0,
        also: Sequence[int] = (),
    ) -> httpx.Response:
        """Repeat a request until it is answered.

        Parameters
        ----------
        kind
            For the board: what the client is doing.
        data
            The body, sent in pieces over `seconds`.
        also
            Statuses that are answers too, beside those of success.

        Raises
        ------
        RefusedError
            Where it is refused for good.
        GaveUpError
            Where it is not answered.
        """
        pause_s, end_s = FIRST_PAUSE_S, time.monotonic() + PATIENCE_S
        try:
            while True:
                answer = self._try(
                    kind, method, path, headers=dict(headers or {}), json=json, data=data, seconds=seconds
                )
                if answer is not None and (answer.is_success or answer.status_code in also):
                    return answer
                wanted_s = self._pause_wanted(answer)
                if self._over.wait(max(pause_s * self._rng.uniform(0.5, 1.0), wanted_s)) or time.monotonic() > end_s:
                    raise GaveUpError(f"{method} {path}: {'no answer' if answer is None else answer.text[:300]}")
                pause_s = min(2 * pause_s, LONGEST_PAUSE_S)
        finally:
            self._board.release(id(self))

    def _try(
        self,
        kind: str,
        method: str,
        path: str,
        *,
        headers: dict[str, str],
        json: Any,
        data: bytes | None,
        seconds: float,
    ) -> httpx.Response | None:
        """The answer to one try, None where the connection broke."""
        content: Iterator[bytes] | bytes | None = data
        if data is not None and seconds > 0:
            headers["Content-Length"] = str(len(data))
            content = self._slowly(data, seconds)
        self._asked = self._board.begin(kind, self._port)
        outcome = "broken"
        try:
            answer = self._http.request(
                method, path, headers=headers, json=json, content=content, extensions={"trace": self._note_connection}
            )
            outcome = str(answer.status_code)
        except httpx.TransportError:
            return None
        finally:
            self._board.end(self._asked, outcome)
        return answer

    def _slowly(self, data: bytes, seconds: float) -> Iterator[bytes]:
        """As over a thin line, so that a kill finds the body at any byte."""
        pieces = range(0, len(data), PIECE_BYTES)
        for start in pieces:
            yield data[start : start + PIECE_BYTES]
            time.sleep(seconds / len(pieces) * self._rng.uniform(0.0, 2.0))

    def _note_connection(self, event: str, info: Mapping[str, Any]) -> None:
        if event == "connection.connect_tcp.complete":
            self._port = info["return_value"].get_extra_info("client_addr")[1]
        if self._asked is not None:
            self._asked.port = self._port

    def _pause_wanted(self, answer: httpx.Response | None) -> float:
        """Seconds that the answer asks to wait before the next try.

        Raises
        ------
        RefusedError
            Where there is no sense in another.
        """
        if answer is None:
            return 0.0
        is_held = answer.status_code == httpx.codes.CONFLICT and _IN_FLIGHT in answer.text
        if is_held:
            self._board.hold(id(self))
        else:
            self._board.release(id(self))
        if not is_held and answer.status_code not in _PASSING:
            asked = answer.request
            raise RefusedError(f"{asked.method} {asked.url.path}: {answer.status_code} {answer.text[:500]}")
        wanted = answer.headers.get("retry-after", "0")
        return float(wanted) if wanted.isdecimal() else 0.0
