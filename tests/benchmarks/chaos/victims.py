"""Who is killed, and when: purposes in a shuffled order, each at a random moment at which it can be fulfilled."""

from __future__ import annotations

import json
import random
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

from tests.benchmarks.chaos.conversation import Board, Try
from tests.benchmarks.chaos.installation import Installation
from tests.benchmarks.chaos.processes import Identity, Process, Role, holder_of, kill, tree_of
from tests.benchmarks.chaos.records import Records, nearest_s
from tests.benchmarks.chaos.sending import COMMIT, UPLOADS

NEAR_S = 1.0
OPPORTUNITY_WITHIN_S = 60.0  # a purpose without one waits for its turn to come again
_LOOK_EVERY_S = 0.02
_RESULT = "result.json"  # of an attempt whose engine has ended: its worker publishes next
_REQUEST = "request.json"


class Purpose(StrEnum):
    """What a kill is for; how many of each there must be is in `shares_of`."""

    ENGINE = "engine"
    API = "api during an upload or commit"
    WORKER = "worker or reconciler"
    PUBLICATION = "near a publication"
    OTHER = "other"


_OF_200 = {Purpose.ENGINE: 60, Purpose.API: 60, Purpose.WORKER: 60, Purpose.PUBLICATION: 10}
_WORKERS = (Role.WORKER, Role.WORKER_POOL, Role.CHECKER, Role.CHECKER_POOL, Role.RECONCILER)
_PUBLISHERS = (Role.WORKER_POOL, Role.WORKER_POOL, Role.WORKER, Role.RECONCILER, Role.BROKER, Role.API)
_OTHERS = (Role.SUPERVISOR, Role.BROKER, Role.GUARD, Role.API_TRACKER)
_COMMIT_SHARE = 0.35  # of the kills of the API
_WHOLE_API_SHARE = 0.35  # of them kill what watches the API's processes
_READER_SHARE = 0.2  # of those during a commit kill what reads the manifest


def shares_of(kills: int) -> dict[Purpose, int]:
    """How many of so many kills are for what, at least one for each but the last, which gets what is left."""
    shares = {purpose: max(1, kills * of_200 // 200) for purpose, of_200 in _OF_200.items()}
    return {**shares, Purpose.OTHER: max(0, kills - sum(shares.values()))}


@dataclass(frozen=True)
class Attempt:
    """What a worker had in hand: its result was written at `result_s`."""

    job_id: str
    fence: int
    result_s: float


@dataclass(frozen=True, kw_only=True)
class Kill:
    """One kill. Times are those of `time.time`."""

    purpose: Purpose
    role: Role
    under_way: str
    at_s: float
    request: Try | None = None  # of a client, that the victim served
    attempt: Attempt | None = None  # that was about to be published


class Killer:
    """Kills processes of one installation.

    Parameters
    ----------
    pause_s
        Between two kills, on average.
    """

    def __init__(self, installation: Installation, board: Board, rng: random.Random, *, pause_s: float) -> None:
        self.kills: list[Kill] = []
        self.restarts_s: list[float] = []
        self.ended_by_itself: list[str] = []
        self._installation, self._board, self._rng, self._pause_s = installation, board, rng, pause_s
        self._records = Records(installation.data)
        self._known: set[Identity] = set()
        self._killed_all = False
        self._find: Mapping[Purpose, Callable[[], Kill | None]] = {
            Purpose.ENGINE: self._kill_engine,
            Purpose.API: self._kill_api,
            Purpose.WORKER: lambda: self._kill_one_of(Purpose.WORKER, _WORKERS),
            Purpose.PUBLICATION: self._kill_at_publication,
            Purpose.OTHER: lambda: self._kill_one_of(Purpose.OTHER, _OTHERS),
        }

    @property
    def known(self) -> list[Identity]:
        """All processes that were seen in the tree."""
        return list(self._known)

    def run(self, kills: int, *, until_s: float, meanwhile: Callable[[], None], tell: Callable[[Kill], None]) -> None:
        """Kill so often, or until `time.monotonic`; and more often where kills missed their purpose.

        Parameters
        ----------
        meanwhile
            Called several times a second.
        """
        shares = shares_of(kills)
        deck = [purpose for purpose, share in shares.items() for _ in range(share)]
        self._rng.shuffle(deck)
        while (deck := deck or self._missing(shares)) and time.monotonic() < until_s:
            self._idle(self._rng.uniform(0.3, 1.7) * self._pause_s, meanwhile)
            purpose = deck.pop(0)
            done = self._once(purpose, min(until_s, time.monotonic() + OPPORTUNITY_WITHIN_S), meanwhile)
            if done is not None:
                self.kills.append(done)
                tell(done)
            if done is None:
                deck.insert(self._rng.randint(0, len(deck)), purpose)

    def _missing(self, shares: Mapping[Purpose, int]) -> list[Purpose]:
        """What is not fulfilled by what was in fact killed, once what is being published has had its time."""
        time.sleep(2 * NEAR_S)
        done = counted(self.kills, self._records)
        return [purpose for purpose, count in done.items() for _ in range(shares[purpose] - count)]

    def _once(self, purpose: Purpose, until_s: float, meanwhile: Callable[[], None]) -> Kill | None:
        while time.monotonic() < until_s:
            done = self._find[purpose]()
            if done is not None:
                return done
            self._idle(_LOOK_EVERY_S, meanwhile)
        return None

    def _idle(self, seconds: float, meanwhile: Callable[[], None]) -> None:
        end_s = time.monotonic() + seconds
        while True:
            self.operate()
            meanwhile()
            left_s = end_s - time.monotonic()
            if left_s <= 0:
                return
            time.sleep(min(left_s, 0.2))

    def operate(self) -> None:
        """As an operator does: start what has ended, and notice what has ended by itself."""
        if self._installation.pid is None:
            if not self._killed_all:
                self.ended_by_itself.append(self._installation.output[-1000:])
            self._killed_all = False
            self.restarts_s.append(self._installation.start())
        self._tree()

    def _tree(self) -> list[Process]:
        pid = self._installation.pid
        found = [] if pid is None else tree_of(pid)
        self._known.update(process.identity for process in found)
        return found

    def _choose(self, *roles: Role) -> Process | None:
        """A process of a random one of those roles that there are."""
        found = self._tree()
        there = [role for role in roles if any(process.role is role for process in found)]
        if not there:
            return None
        role = self._rng.choice(there)
        return self._rng.choice([process for process in found if process.role is role])

    def _kill_engine(self) -> Kill | None:
        if self._choose(Role.ENGINE) is None:
            return None
        time.sleep(self._rng.uniform(0.0, 4.0))  # else each would be killed as soon as it is there
        victim = self._choose(Role.ENGINE)
        return None if victim is None else self._kill(Purpose.ENGINE, victim, self._work_of(victim))

    def _kill_one_of(self, purpose: Purpose, roles: Sequence[Role]) -> Kill | None:
        victim = self._choose(*roles)
        return None if victim is None else self._kill(purpose, victim, self._busy_with(victim))

    def _kill_api(self) -> Kill | None:
        """While it serves a request that brings bytes or commits; the process that has its connection, or all."""
        asked = self._request([COMMIT] if self._rng.random() < _COMMIT_SHARE else UPLOADS)
        if asked is None:
            return None
        time.sleep(self._rng.uniform(0.0, 0.4))
        victim = self._server_of(asked)
        if victim is None or asked.ended_s is not None:
            return None
        return self._kill(Purpose.API, victim, asked.kind, request=asked)

    def _request(self, kinds: Sequence[str]) -> Try | None:
        end_s = time.monotonic() + 5.0  # then perhaps of another kind
        while time.monotonic() < end_s:
            under_way = self._board.under_way(kinds)
            if under_way:
                return self._rng.choice(under_way)
            time.sleep(_LOOK_EVERY_S)
        return None

    def _server_of(self, asked: Try) -> Process | None:
        found = self._tree()
        children = [process for process in found if process.role is Role.API_CHILD]
        serves = holder_of(children, local_port=self._installation.port, remote_port=asked.port or 0)
        if serves is None:
            return None
        readers = [process for process in found if process.role is Role.MANIFEST_READER]
        if asked.kind == COMMIT and readers and self._rng.random() < _READER_SHARE:
            return self._rng.choice(readers)
        if self._rng.random() < _WHOLE_API_SHARE:
            return next((process for process in found if process.role is Role.API), serves)
        return serves

    def _kill_at_publication(self) -> Kill | None:
        """When an engine has left its result: what publishes it, or what that needs."""
        attempts = self._finished()
        fresh = [attempt for attempt in attempts if time.time() - attempt.result_s < 0.2]
        if not fresh:
            return None
        time.sleep(self._rng.uniform(0.0, 0.7))
        role = self._rng.choice(_PUBLISHERS)
        holder = self._records.holder_of(fresh[0].job_id)
        found = [process for process in self._tree() if process.role is role]
        if role is Role.WORKER_POOL and holder is not None:
            found = [process for process in found if process.pid == holder]
        if not found:
            return None
        work = self._records.work_of(fresh[0].job_id)
        return self._kill(Purpose.PUBLICATION, self._rng.choice(found), work, attempt=fresh[0])

    def _finished(self) -> list[Attempt]:
        """Attempts at scenes and maps whose engine has ended."""
        found = []
        for result in (self._installation.data / "scratch").glob(f"*/{_RESULT}"):
            job_id, _, fence = result.parent.name.rpartition(".")
            try:
                work = json.loads((result.parent / _REQUEST).read_bytes())["work"]
                written_s = result.stat().st_mtime
            except (OSError, ValueError):  # gone meanwhile
                continue
            if work != "preflight":
                found.append(Attempt(job_id, int(fence), written_s))
        return found

    def _kill(
        self,
        purpose: Purpose,
        victim: Process,
        under_way: str,
        *,
        request: Try | None = None,
        attempt: Attempt | None = None,
    ) -> Kill | None:
        at_s = time.time()
        if not kill(victim):
            return None
        if victim.role is Role.SUPERVISOR:
            self._installation.reap()
            self._killed_all = True
        return Kill(purpose=purpose, role=victim.role, under_way=under_way, at_s=at_s, request=request, attempt=attempt)

    def _busy_with(self, victim: Process) -> str:
        """What a worker, or what is above it, has in hand: its engines' work."""
        found = self._tree()
        below = {victim.pid}
        for process in found:  # parents first
            if process.parent in below:
                below.add(process.pid)
        if victim.role in (Role.BROKER, Role.RECONCILER, Role.GUARD):
            below = {process.pid for process in found}
        engines = [process for process in found if process.role is Role.ENGINE and process.pid in below]
        return "; ".join(sorted(self._work_of(engine) for engine in engines)) or "nothing"

    def _work_of(self, engine: Process) -> str:
        attempt = Path(engine.command[-1]).parent.name
        return self._records.work_of(attempt.rpartition(".")[0])


def was_in_a_request(done: Kill) -> bool:
    """Whether the victim served an upload or a commit that had not been answered."""
    return done.request is not None and done.request.was_under_way(done.at_s)


def was_near_a_publication(done: Kill, records: Records) -> bool:
    """Whether a result was recorded within a second of the kill, or was being stored and never recorded."""
    return nearest_s(records.published_s(), done.at_s) <= NEAR_S or has_ended_a_publication(done, records)


def has_ended_a_publication(done: Kill, records: Records) -> bool:
    """Whether an attempt's result was written in the second before the kill, and that attempt never published it."""
    attempt = done.attempt
    if attempt is None or not 0 <= done.at_s - attempt.result_s <= NEAR_S:
        return False
    return records.publication_s(attempt.job_id, attempt.fence) is None


def counted(kills: Sequence[Kill], records: Records) -> dict[Purpose, int]:
    """How many kills were of each kind in fact, whatever they were meant for; one may be of several."""
    return {
        Purpose.ENGINE: sum(done.role is Role.ENGINE for done in kills),
        Purpose.API: sum(was_in_a_request(done) for done in kills),
        Purpose.WORKER: sum(done.role in _WORKERS for done in kills),
        Purpose.PUBLICATION: sum(was_near_a_publication(done, records) for done in kills),
    }


def histogram(kills: Sequence[Kill]) -> dict[str, dict[str, int]]:
    """Victims by role and by what was under way."""
    counts: dict[str, Counter[str]] = {}
    for done in kills:
        counts.setdefault(done.role.value, Counter())[done.under_way] += 1
    return {role: dict(counts[role].most_common()) for role in sorted(counts)}
