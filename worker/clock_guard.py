"""Guards leases against clocks that jump: the silence of a worker does not always mean its death."""

from __future__ import annotations

import time

_SHARE = 0.25  # of a lease: a live worker has more than that left at any time


class ClockGuard:
    """Tells the death of a worker from a clock that was set, a machine that slept, and a database out of reach.

    After any of these every lease may have run out with its worker alive, so for the length of a lease none counts.
    """

    def __init__(self, lease_s: float) -> None:
        self._lease_s = lease_s
        self._seen: tuple[float, float] | None = None
        self._counts_from_s = 0.0
        self._asked_s: float | None = None
        self._excused = False

    def ask(self) -> None:
        """The database is about to be asked for its turn to write."""
        if self._asked_s is None:
            self._asked_s = time.monotonic()

    def counts(self, clock_us: int) -> bool:
        """Return whether leases that have run out may be taken as such; called when the turn to write is there.

        Parameters
        ----------
        clock_us
            Of the database that the leases are in, now.
        """
        # The monotonic clock stands still while the machine sleeps, so it tells of that, too.
        now_s, wall_s = time.monotonic(), clock_us / 1e6
        away_s = 0.0 if self._asked_s is None else now_s - self._asked_s
        jumped_s = 0.0 if self._seen is None else wall_s - self._seen[1] - (now_s - self._seen[0])
        self._asked_s, self._seen = None, (now_s, wall_s)
        if abs(jumped_s) > _SHARE * self._lease_s:
            self._counts_from_s = now_s + self._lease_s
        if away_s <= _SHARE * self._lease_s:
            self._excused = False
        elif not self._excused:  # once: where every turn takes so long, jobs of dead workers must not wait for ever
            self._excused = True
            self._counts_from_s = max(self._counts_from_s, now_s + self._lease_s)
        return now_s >= self._counts_from_s
