"""What must hold when all kills are over: nothing lost, nothing twice, nothing stuck, no wrong byte, nothing left."""

from __future__ import annotations

import base64
import hashlib
import os
import re
import sqlite3
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import httpx

from tests.benchmarks.chaos.ledger import TERMINAL, AcceptedDrive, Ledger
from tests.benchmarks.chaos.records import Records

_PAGE = 200
_BY_DESIGN = re.compile(
    r"spool/[0-9a-f]{32}\.part|uploads/upl_[0-9a-f]{30}\.bytes"
)  # collected later: see `kept_files`


@dataclass
class Findings:
    """What is wrong, a line each."""

    lost: list[str] = field(default_factory=list)
    twice: list[str] = field(default_factory=list)
    stuck: list[str] = field(default_factory=list)
    wrong_bytes: list[str] = field(default_factory=list)
    failed: list[str] = field(default_factory=list)  # for kills alone: no drive that is sent has a defect
    damaged: list[str] = field(default_factory=list)  # records
    left: list[str] = field(default_factory=list)  # processes and files

    @property
    def total(self) -> int:
        return sum(len(found) for found in vars(self).values())


@dataclass
class Shown:
    """What the service has of the project."""

    drives: Mapping[str, dict[str, Any]]
    jobs: Mapping[str, dict[str, Any]]
    scenes: Mapping[str, dict[str, Any]]
    maps: Mapping[str, dict[str, Any]]


def shown_by(client: httpx.Client) -> Shown:
    """All of it, page by page."""
    return Shown(*({item["id"]: item for item in _pages(client, f"/v1/{what}")} for what in _LISTED))


_LISTED = ("drives", "jobs", "scenes", "maps")


def check_drives(client: httpx.Client, ledger: Ledger, shown: Shown, findings: Findings) -> None:
    """Every accepted drive is committed, with its manifest and its files, and there is no other."""
    for drive_id, accepted in ledger.drives.items():
        found = shown.drives.get(drive_id)
        if found is None or found["state"] != "COMMITTED":
            findings.lost.append(f"drive {drive_id}: {'not there' if found is None else found['state']}")
            continue
        _check_files_of(client, accepted, findings)
    for drive_id in shown.drives.keys() - ledger.created:
        findings.twice.append(f"drive {drive_id}, {shown.drives[drive_id]['name']}: nobody knows of it")
    checks = Counter(job["drive_id"] for job in shown.jobs.values() if job["kind"] == "PREFLIGHT")
    for drive_id in ledger.drives:
        if checks[drive_id] != 1:
            (findings.twice if checks[drive_id] else findings.lost).append(
                f"checks of drive {drive_id}: {checks[drive_id]}"
            )


def _check_files_of(client: httpx.Client, accepted: AcceptedDrive, findings: Findings) -> None:
    url = f"/v1/drives/{accepted.id}"
    if client.get(f"{url}/manifest").content != accepted.manifest:
        findings.wrong_bytes.append(f"{url}/manifest: other bytes than were sent")
    stored = {file["path"]: file["sha256"] for file in _pages(client, f"{url}/files")}
    for path, sha256 in accepted.files.items():
        if stored.get(path) is None:
            findings.lost.append(f"{url}/files/{path}: not stored")
        elif stored[path] != sha256:
            findings.wrong_bytes.append(f"{url}/files/{path}: stored as {stored[path]}, sent as {sha256}")
    for path in stored.keys() - accepted.files.keys():
        findings.twice.append(f"{url}/files/{path}: nobody sent it")


def check_jobs(ledger: Ledger, shown: Shown, findings: Findings) -> None:
    """Every accepted job is there and has succeeded, as have the checks and what aggregations asked for."""
    members = {
        member["job_id"]
        for job in shown.jobs.values()
        if job["id"] in ledger.jobs
        for member in job["members"]
        if member["job_id"] is not None
    }
    for job_id, accepted in ledger.jobs.items():
        if job_id not in shown.jobs:
            findings.lost.append(f"job {job_id}, {accepted.kind}: not there")
    for job_id, job in shown.jobs.items():
        name = f"job {job_id}, {job['kind']}"
        if job["kind"] != "PREFLIGHT" and job_id not in ledger.jobs and job_id not in members:
            findings.twice.append(f"{name}: nobody asked for it")
        if job["state"] not in TERMINAL:
            findings.stuck.append(f"{name}: {job['state']} in stage {job['progress']['stage']}")
        elif job["state"] != "SUCCEEDED":
            findings.failed.append(f"{name}: {job['state']}, {_why(job)}")


def _why(job: Mapping[str, Any]) -> str:
    problem = job["problem"] or {}
    outcomes = [attempt["outcome"] for attempt in job["attempts"]]
    return f"{problem.get('type', '').rpartition(':')[2]}: {problem.get('detail')} (attempts: {outcomes})"


def check_scenes(client: httpx.Client, shown: Shown, findings: Findings) -> None:
    """Each reconstruction that succeeded has one scene, no other has one, and all files download as recorded."""
    scenes = Counter(scene["job_id"] for scene in shown.scenes.values())
    made = {job_id for job_id, job in shown.jobs.items() if job["kind"] == "RECONSTRUCTION" and _succeeded(job)}
    _check_counts("scenes", scenes, made, findings)
    for scene_id, scene in shown.scenes.items():
        job = shown.jobs.get(scene["job_id"])
        if job is not None and job["scene_id"] != scene_id:
            findings.twice.append(f"scene {scene_id}: its job has {job['scene_id']}")
        _check_downloads(client, f"/v1/scenes/{scene_id}", findings)


def check_maps(client: httpx.Client, ledger: Ledger, shown: Shown, findings: Findings) -> None:
    """Each aggregation that succeeded has one version, which has all drives that were asked for."""
    made = {job_id for job_id, job in shown.jobs.items() if job["kind"] == "AGGREGATION" and _succeeded(job)}
    versions: Counter[str] = Counter()
    for map_id in shown.maps:
        for version in _pages(client, f"/v1/maps/{map_id}/versions"):
            versions[version["job_id"]] += 1
            name = f"/v1/maps/{map_id}/versions/{version['number']}"
            accepted = ledger.jobs.get(version["job_id"])
            drives = sorted(scene["drive_id"] for scene in version["scenes"])
            if accepted is not None and drives != sorted(accepted.drive_ids):
                findings.lost.append(f"{name}: of {drives}, asked for {sorted(accepted.drive_ids)}")
            _check_downloads(client, name, findings)
    _check_counts("versions of maps", versions, made, findings)


def _check_counts(what: str, counts: Counter[str], made: set[str], findings: Findings) -> None:
    for job_id in made | set(counts):
        wanted = int(job_id in made)
        if counts[job_id] != wanted:
            kind = findings.lost if counts[job_id] < wanted else findings.twice
            kind.append(f"{what} of job {job_id}: {counts[job_id]}, not {wanted}")


def _check_downloads(client: httpx.Client, url: str, findings: Findings) -> None:
    files = client.get(url).raise_for_status().json()["files"]
    if not files:
        findings.lost.append(f"{url}: no file")
    for file in files:
        answer = client.get(file["url"])
        digest = hashlib.sha256(answer.content)
        told = f"sha-256=:{base64.b64encode(digest.digest()).decode()}:"
        size_bytes = len(answer.content)
        if answer.status_code != httpx.codes.OK:
            findings.lost.append(f"{file['url']}: {answer.status_code}")
        elif (digest.hexdigest(), size_bytes) != (file["sha256"], file["size_bytes"]):
            findings.wrong_bytes.append(f"{file['url']}: {size_bytes} bytes of {digest.hexdigest()}")
        elif answer.headers.get("repr-digest") != told:
            findings.wrong_bytes.append(f"{file['url']}: Repr-Digest is {answer.headers.get('repr-digest')}")


def check_records(records: Records, findings: Findings) -> None:
    """The database is sound; no job ended twice, and nothing holds one."""
    try:
        _check_integrity(records, findings)
        _check_ends(records, findings)
    except sqlite3.DatabaseError as error:
        findings.damaged.append(f"the database cannot be read: {error}")


def _check_integrity(records: Records, findings: Findings) -> None:
    for pragma in ("integrity_check", "foreign_key_check"):
        said = [row for row in records.rows(f"PRAGMA {pragma}") if row != ("ok",)]
        findings.damaged += [f"{pragma}: {row}" for row in said]


def _check_ends(records: Records, findings: Findings) -> None:
    ends = records.rows(
        "SELECT job_id, count(*) FROM job_events WHERE kind = 'state' AND json_extract(data, '$.state') = 'SUCCEEDED' "
        "GROUP BY job_id HAVING count(*) > 1"
    )
    findings.twice += [f"job {job_id} has told {count} times that it succeeded" for job_id, count in ends]
    wins = records.rows(
        "SELECT job_id, count(*) FROM job_attempts WHERE outcome = 'succeeded' GROUP BY job_id HAVING count(*) > 1"
    )
    findings.twice += [f"job {job_id} has {count} attempts that succeeded" for job_id, count in wins]
    told = records.rows(
        "SELECT id FROM jobs WHERE state = 'SUCCEEDED' AND NOT EXISTS (SELECT 1 FROM job_events WHERE job_id = jobs.id "
        "AND job_events.kind = 'state' AND json_extract(data, '$.state') = 'SUCCEEDED')"
    )
    findings.lost += [f"job {job_id} has never told that it succeeded" for (job_id,) in told]
    open_attempts = records.rows("SELECT job_id, fence FROM job_attempts WHERE finished_us IS NULL")
    findings.stuck += [f"attempt {fence} at job {job_id} has not ended" for job_id, fence in open_attempts]


def check_store(records: Records, data: Path, ledger: Ledger, findings: Findings) -> int:
    """Every object that the records name has the bytes that they say, and drives' files those that were sent.

    Returns
    -------
    int
        How many objects no record names: what was killed leaves them, and they are collected when a day old.
    """
    store = data / "artifacts"
    named = set()
    for key, sha256, size_bytes in records.rows("SELECT key, sha256, size_bytes FROM blobs"):
        named.add(store / key)
        _check_object(store / key, sha256, size_bytes, findings)
    sent = {(d.id, path): sha256 for d in ledger.drives.values() for path, sha256 in d.files.items()}
    files = "SELECT drive_id, path, key FROM drive_files JOIN blobs ON blobs.id = blob_id"
    for drive_id, path, key in records.rows(files):
        sha256 = sent.get((drive_id, path))
        if sha256 is not None and (store / key).is_file() and _sha256_of(store / key) != sha256:
            findings.wrong_bytes.append(f"{path} of drive {drive_id}: not the bytes that were sent")
    return sum(path.is_file() and path not in named for path in store.rglob("*"))


def _check_object(path: Path, sha256: str, size_bytes: int, findings: Findings) -> None:
    if not path.is_file():
        findings.lost.append(f"object {path.name}: not in the store")
    elif path.stat().st_size != size_bytes or _sha256_of(path) != sha256:
        findings.wrong_bytes.append(f"object {path.name}: not the bytes of {sha256}")


def kept_files(data: Path) -> list[Path]:
    """What killed processes left and the service keeps for a while: bodies under way, and uploads' bytes."""
    found = (path for name in ("spool", "uploads") for path in (data / name).glob("*"))
    return sorted(path for path in found if _BY_DESIGN.fullmatch(path.relative_to(data).as_posix()))


def age(files: Sequence[Path], seconds: float) -> None:
    """Let files be older than they are."""
    for path in files:
        changed_s = path.stat().st_mtime - seconds
        os.utime(path, (changed_s, changed_s))


def check_folders(data: Path, temporary: Sequence[Path], findings: Findings) -> None:
    """Nothing is left where uploads and attempts work, nor in temporary folders."""
    working = (path for name in ("spool", "uploads", "scratch") for path in (data / name).rglob("*"))
    findings.left += [f"file {path.relative_to(data)}" for path in sorted(working)]
    findings.left += [f"temporary file {path}" for path in sorted(temporary)]


def _succeeded(job: Mapping[str, Any]) -> bool:
    return bool(job["state"] == "SUCCEEDED")


def _sha256_of(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _pages(client: httpx.Client, url: str) -> Iterator[dict[str, Any]]:
    cursor: str | None = None
    while True:
        page = client.get(url, params={"limit": _PAGE, **({"cursor": cursor} if cursor else {})}).raise_for_status()
        yield from page.json()["items"]
        cursor = page.json()["next"]
        if cursor is None:
            return
