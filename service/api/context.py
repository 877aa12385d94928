"""Objects that every request needs: settings, database, artifact store and broker, opened once per process."""

from __future__ import annotations

from dataclasses import dataclass, field

import anyio

from service.api.http.event_streams import EventStreams
from service.api.http.fair_places import FairPlaces, FairThreads
from service.database.connections import Database
from service.domain.keys import KeyRing
from service.domain.request_holds import HoldKeeper
from service.job_queue import JobQueue
from service.settings import Settings
from service.storage.artifacts import ArtifactStore
from service.storage.garbage_collection import Collector
from service.storage.uploads.archive_watch import KeptWatches

_LARGE_BODIES = 4
_LARGE_BODIES_WAITING = 16  # of one project; the beginning of each is in memory
DOCUMENT_WITHIN_S = 300.0  # how long one waits to be parsed; it is here already, and to send it again would cost more
_COMMITS = 2
_UNPACKING = 2


@dataclass(frozen=True, kw_only=True)
class Context:
    """The API process's resources."""

    settings: Settings
    database: Database
    keys: KeyRing
    holds: HoldKeeper
    artifacts: ArtifactStore
    collector: Collector
    job_queue: JobQueue
    disk: anyio.CapacityLimiter  # uploads that write at one time
    large_bodies: FairPlaces  # JSON bodies that are in memory at one time
    large_documents: FairPlaces  # of these, what is parsed and recorded at one time
    streams: EventStreams
    commits: FairThreads
    unpacking: FairThreads
    archive_watches: KeptWatches = field(default_factory=KeptWatches)

    @classmethod
    def open(cls, settings: Settings) -> Context:
        """Open everything that the settings name; the broker is not asked."""
        database = Database.from_settings(settings)
        artifacts = ArtifactStore.open(settings, database)
        return cls(
            settings=settings,
            database=database,
            keys=KeyRing(database),
            holds=HoldKeeper(database),
            artifacts=artifacts,
            collector=Collector(database, artifacts),
            job_queue=JobQueue(settings),
            disk=anyio.CapacityLimiter(settings.max_concurrent_writes),
            large_bodies=FairPlaces(
                _LARGE_BODIES, per_project=_LARGE_BODIES // 2, waiting_per_project=_LARGE_BODIES_WAITING
            ),
            large_documents=FairPlaces(1, per_project=1, waiting_per_project=_LARGE_BODIES),
            streams=EventStreams(settings.max_event_streams),
            commits=FairThreads(_COMMITS),
            unpacking=FairThreads(_UNPACKING),
        )

    def close(self) -> None:
        """Give back what was opened."""
        self.holds.close()
        self.collector.close()
        self.database.close()
