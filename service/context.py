"""What every request needs: settings, database, artifact store and broker, opened once a process."""

from __future__ import annotations

from dataclasses import dataclass

import anyio

from service.persistence.artifacts import ArtifactStore
from service.persistence.database import Database
from service.persistence.keys import KeyRing
from service.persistence.wakeups import Wakeups
from service.settings import Settings

_LARGE_BODIES = 4
_COMMITS = 2
_UNPACKING = 2


@dataclass(frozen=True, kw_only=True)
class Context:
    """The API process's resources."""

    settings: Settings
    database: Database
    keys: KeyRing
    artifacts: ArtifactStore
    wakeups: Wakeups
    disk: anyio.CapacityLimiter  # uploads that write at one time
    large_bodies: anyio.CapacityLimiter  # JSON bodies that are in memory at one time
    large_documents: anyio.CapacityLimiter  # of these, what is parsed and recorded at one time
    # Of their own, so that what takes minutes leaves the threads of all other requests alone.
    commits: anyio.CapacityLimiter
    unpacking: anyio.CapacityLimiter

    @classmethod
    def open(cls, settings: Settings) -> Context:
        """Open everything that the settings name; the broker is not asked."""
        database = Database.of(settings)
        return cls(
            settings=settings,
            database=database,
            keys=KeyRing(database),
            artifacts=ArtifactStore(settings),
            wakeups=Wakeups(settings),
            disk=anyio.CapacityLimiter(settings.max_concurrent_writes),
            large_bodies=anyio.CapacityLimiter(_LARGE_BODIES),
            large_documents=anyio.CapacityLimiter(1),
            commits=anyio.CapacityLimiter(_COMMITS),
            unpacking=anyio.CapacityLimiter(_UNPACKING),
        )
