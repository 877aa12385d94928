"""The service as a Python library: what `mrasfm upload` is made of.

>>> from pathlib import Path
>>> from service.client import Client, DriveFolder, download, watch_job, start_reconstruction, upload_drive
>>> with Client("https://maps.example.org", key) as client:  # doctest: +SKIP
...     sent = upload_drive(client, DriveFolder.read(Path("my-drive")))
...     job = watch_job(client, start_reconstruction(client, sent.drive_id).id)
...     download(client, client.scene(job.scene_id), Path("my-scene"))

What can go wrong is a `ClientError`: an `ApiError` carries the problem that the service answered with.
"""

from schemas.api.drives import PreflightState
from schemas.api.jobs import JobKind, JobState
from service.client.api import Client, JobEvent, Result
from service.client.async_client import AsyncClient
from service.client.download import Downloaded, download
from service.client.drive_folder import DriveFolder, LocalFile
from service.client.errors import ApiError, ClientError, DriveFolderError, SceneFolderError, UnreachableError
from service.client.job_watcher import ENDED, JobNews, watch_job
from service.client.report import scene_findings
from service.client.upload import Sent, start_aggregation, start_reconstruction, upload_drive
from service.client.upload_state import UploadState

__all__ = [
    "ENDED",
    "ApiError",
    "AsyncClient",
    "Client",
    "ClientError",
    "Downloaded",
    "DriveFolder",
    "DriveFolderError",
    "JobEvent",
    "JobKind",
    "JobNews",
    "JobState",
    "LocalFile",
    "PreflightState",
    "Result",
    "SceneFolderError",
    "Sent",
    "UnreachableError",
    "UploadState",
    "download",
    "scene_findings",
    "start_aggregation",
    "start_reconstruction",
    "upload_drive",
    "watch_job",
]
