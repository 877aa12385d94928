"""What the clients do all the time: bring drives, ask for scenes and maps of them, and follow the jobs."""

from __future__ import annotations

import itertools
import random
import threading
import time
from collections.abc import Callable, Sequence

from tests.benchmarks.chaos.conversation import Board, CarefulClient, GaveUpError, RefusedError
from tests.benchmarks.chaos.drives import RenderedPair, Sendable
from tests.benchmarks.chaos.ledger import Ledger
from tests.benchmarks.chaos.sending import FOLLOW, Sender

CLIENTS = 3  # that are not held up by an earlier request of theirs
MOST_THREADS = 60
MOST_UNFINISHED = 5  # jobs; more would only wait longer after the last kill
ASK = "ask"
FOLLOW_EVERY_S = 1.0
SAME_IMAGES = 0.2  # of the drives have the images of another: their bytes are stored once
_SETTINGS = {"max_keypoints": 600}
_UNCHECKED = ("NONE", "PENDING")


class Traffic:
    """Clients in threads, from `start` until `finish`, which lets them end what they have begun."""

    def __init__(self, url: str, key: str, pair: RenderedPair, seed: int) -> None:
        self.board, self.ledger = Board(), Ledger()
        self._url, self._key, self._pair = url, key, pair
        self._seed = seed
        self._numbers = itertools.count()
        self._finishing, self._over = threading.Event(), threading.Event()
        self._threads: list[threading.Thread] = []
        self._follower = threading.Thread(target=self._in_thread, args=(self._follow,), name="follower")

    def start(self) -> None:
        """Begin."""
        self._follower.start()
        self.tend()

    def tend(self) -> None:
        """Have as many clients at work as there shall be, however many are held up."""
        self._threads = [thread for thread in self._threads if thread.is_alive()]
        missing = CLIENTS + self.board.held - len(self._threads)
        for _ in range(min(missing, MOST_THREADS - len(self._threads))):
            thread = threading.Thread(target=self._in_thread, args=(self._work,), name="client")
            self._threads.append(thread)
            thread.start()

    def finish(self, until_s: float) -> bool:
        """Begin nothing new, and wait until `time.monotonic` for what was begun; whether all has ended."""
        self._finishing.set()
        for thread in [*self._threads, self._follower]:
            thread.join(max(0.0, until_s - time.monotonic()))
        return not any(thread.is_alive() for thread in [*self._threads, self._follower])

    def abandon(self) -> None:
        """End everything now."""
        self._finishing.set()
        self._over.set()
        for thread in [*self._threads, self._follower]:
            if thread.ident is not None:
                thread.join()

    def _in_thread(self, work: Callable[[CarefulClient, random.Random], None]) -> None:
        rng = random.Random(f"{self._seed} {next(self._numbers)}")
        client = CarefulClient(self._url, self._key, self.board, self._over, rng)
        try:
            work(client, rng)
        except GaveUpError as error:
            if not self._over.is_set():
                self.ledger.note_broken_promise(f"not answered: {error}")
        finally:
            client.close()

    def _work(self, client: CarefulClient, rng: random.Random) -> None:
        sender = Sender(client, self.ledger, rng)
        while not self._finishing.is_set():
            busy = len(self.ledger.unfinished()) >= MOST_UNFINISHED
            errand = self._bring_only if busy else rng.choice([self._scene, self._map_of_drives, self._map_of_scenes])
            try:
                errand(client, sender, rng)
            except RefusedError as error:
                self.ledger.note_broken_promise(f"refused: {error}")
            if busy:
                self._finishing.wait(rng.uniform(1.0, 4.0))

    def _bring_only(self, client: CarefulClient, sender: Sender, rng: random.Random) -> None:
        """A drive, and what its check finds."""
        drive_id = sender.send(self._drive(0, rng))
        while not self._over.wait(FOLLOW_EVERY_S):
            shown = client.ask(FOLLOW, "GET", f"/v1/drives/{drive_id}/preflight").json()
            if shown["state"] not in _UNCHECKED:
                return

    def _scene(self, client: CarefulClient, sender: Sender, rng: random.Random) -> None:
        """A drive to a scene."""
        self._reconstruct(client, sender, sender.send(self._drive(rng.randrange(2), rng)))

    def _map_of_drives(self, client: CarefulClient, sender: Sender, rng: random.Random) -> None:
        """Two drives, whose scenes the aggregation asks for itself."""
        drive_ids = [sender.send(self._drive(which, rng)) for which in range(2)]
        asked = {"drives": drive_ids, "settings": _SETTINGS}
        self._accept(client, sender, "AGGREGATION", "/v1/aggregations", asked, drive_ids)

    def _map_of_scenes(self, client: CarefulClient, sender: Sender, rng: random.Random) -> None:
        """Two drives, their scenes, and when these are there the map of both."""
        drive_ids = [sender.send(self._drive(which, rng)) for which in range(2)]
        job_ids = [self._reconstruct(client, sender, drive_id) for drive_id in drive_ids]
        while not all(job_id in self.ledger.ends for job_id in job_ids):
            if self._over.wait(FOLLOW_EVERY_S):
                return
        scenes = [client.ask(FOLLOW, "GET", f"/v1/jobs/{job_id}").json()["scene_id"] for job_id in job_ids]
        if all(scenes):  # else a job has failed, which is another matter
            asked = {"scenes": scenes, "settings": _SETTINGS}
            self._accept(client, sender, "AGGREGATION", "/v1/aggregations", asked, drive_ids)

    def _reconstruct(self, client: CarefulClient, sender: Sender, drive_id: str) -> str:
        asked = {"drive_id": drive_id, "settings": _SETTINGS}
        return self._accept(client, sender, "RECONSTRUCTION", "/v1/reconstructions", asked, [drive_id])

    def _accept(
        self,
        client: CarefulClient,
        sender: Sender,
        kind: str,
        path: str,
        asked: object,
        drive_ids: Sequence[str],
    ) -> str:
        answer = client.ask(ASK, "POST", path, headers=sender.new_key(), json=asked)
        job_id = str(answer.json()["id"])
        self.ledger.accept_job(job_id, kind, drive_ids)
        return job_id

    def _drive(self, which: int, rng: random.Random) -> Sendable:
        number = next(self._numbers)
        images = "shared" if rng.random() < SAME_IMAGES else f"{self._seed} {number}"
        return self._pair.drive(which, name=f"chaos-{number:04d}", images=images)

    def _follow(self, client: CarefulClient, rng: random.Random) -> None:
        """Look at all jobs until the last has ended, and nobody asks for more."""
        while True:
            no_more = self._finishing.is_set() and not any(thread.is_alive() for thread in self._threads)
            unfinished = self.ledger.unfinished()
            for job_id in unfinished:
                shown = client.ask(FOLLOW, "GET", f"/v1/jobs/{job_id}").json()
                self.ledger.see_state(job_id, shown["state"])
            if (no_more and not unfinished) or self._over.wait(FOLLOW_EVERY_S):
                return
