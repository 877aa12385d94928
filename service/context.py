"""What every request needs: settings, database, artifact store and broker, opened once a process."""

from __future__ import annotations

from dataclasses import dataclass

import anyio

from service.persistence.artifacts import ArtifactStore
from service.persistence.database import Database
from service.persistence.keys import KeyRing
from service.persistence.wakeups import Wakeups
from service.settings import Settings


@dataclass(frozen=True, kw_only=True)
class Context:
    """The API process's resources."""

    settings: Settings
    database: Database
    keys: KeyRing
    artifacts: ArtifactStore
    wakeups: Wakeups
    disk: anyio.CapacityLimiter  # uploads that write at one time
    large_documents: anyio.CapacityLimiter  # that are parsed at one time

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
            large_documents=anyio.CapacityLimiter(1),
        )
