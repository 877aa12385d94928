from __future__ import annotations

import asyncio
import errno
import hashlib
import os
import re
import shutil
import signal
import subprocess
import sys
import threading
import tracemalloc
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import anyio
import pytest
from starlette.requests import ClientDisconnect, Request

from service.digests import format_digest, parse_digest
from service.errors import ServiceError
from service.storage.spool import BATCH_BYTES, Spooled, SpoolWriter, receive, sweep

EMPTY_SHA256 = hashlib.sha256(b"").hexdigest()


async def body(*chunks: bytes) -> AsyncIterator[bytes]:
    for chunk in chunks:
        yield chunk


def receive_now(stream: AsyncIterator[bytes], folder: Path, **options: Any) -> Spooled:
    arguments: dict[str, Any] = {
        "max_bytes": 10_000_000,
        "expected_bytes": None,
        "expected_sha256": None,
        "min_free_bytes": 0,
        "on_disk": asyncio.Semaphore(2),
    }
    return asyncio.run(receive(stream, folder, **(arguments | options)))


def refused(folder: Path, stream: AsyncIterator[bytes], **options: Any) -> ServiceError:
    with pytest.raises(ServiceError) as caught:
        receive_now(stream, folder, **options)
    assert not folder.exists() or not list(folder.iterdir())
    return caught.value


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return tmp_path / "state" / "spool"


@pytest.mark.parametrize("sizes", [(), (0,), (1,), (3, 0, 5), (BATCH_BYTES,), (BATCH_BYTES - 1, 2, 3 * BATCH_BYTES)])
def test_what_was_sent_is_on_the_disk(folder: Path, sizes: tuple[int, ...]) -> None:
    chunks = [os.urandom(size) for size in sizes]
    data = b"".join(chunks)
    digest = hashlib.sha256(data).hexdigest()
    spooled = receive_now(body(*chunks), folder, expected_bytes=len(data), expected_sha256=digest.upper())
    assert (spooled.size_bytes, spooled.sha256) == (len(data), digest)
    assert spooled.path.read_bytes() == data
    with spooled:
        assert re.fullmatch(r"[0-9a-f]{32}\.part", spooled.path.name)
        assert spooled.path.stat().st_mode & 0o777 == 0o600
        assert folder.stat().st_mode & 0o777 == 0o700
    assert list(folder.iterdir()) == []


def test_a_file_that_was_moved_away_is_not_missed(folder: Path, tmp_path: Path) -> None:
    with receive_now(body(b"kept"), folder) as spooled:
        os.rename(spooled.path, tmp_path / "kept")
    assert (tmp_path / "kept").read_bytes() == b"kept"


def test_a_capacity_limiter_bounds_writes_too(folder: Path) -> None:
    async def run() -> list[Spooled]:
        limiter = anyio.CapacityLimiter(1)
        return await asyncio.gather(
            *(
                receive(
                    body(bytes([i]) * BATCH_BYTES, b"end"),
                    folder,
                    max_bytes=10**7,
                    expected_bytes=None,
                    expected_sha256=None,
                    min_free_bytes=0,
                    on_disk=limiter,
                )
                for i in range(5)
            )
        )

    files = asyncio.run(run())
    assert [file.path.read_bytes()[:1] for file in files] == [bytes([i]) for i in range(5)]


def test_too_large(folder: Path) -> None:
    async def never() -> AsyncIterator[bytes]:
        raise AssertionError("the body is not read where the announced length is too large")
        yield b""

    error = refused(folder, never(), max_bytes=99, expected_bytes=100)
    assert (error.status, error.code) == (413, "too-large")
    assert "over 99 bytes" in error.problem.detail

    async def endless() -> AsyncIterator[bytes]:
        while True:
            yield bytes(1 << 16)

    assert refused(folder, endless(), max_bytes=3_000_000).code == "too-large"


@pytest.mark.parametrize(("sent", "word"), [(9, "9 of the 10 bytes"), (11, "more than the 10 bytes"), (0, "0 of")])
def test_wrong_length(folder: Path, sent: int, word: str) -> None:
    error = refused(folder, body(bytes(sent)), expected_bytes=10)
    assert (error.status, error.code) == (400, "wrong-length")
    assert word in error.problem.detail


def test_wrong_digest(folder: Path) -> None:
    error = refused(folder, body(b"other"), expected_sha256=EMPTY_SHA256)
    assert (error.status, error.code) == (422, "wrong-digest")
    assert EMPTY_SHA256 in error.problem.detail
    assert hashlib.sha256(b"other").hexdigest() in error.problem.detail


def test_no_room_is_left(folder: Path) -> None:
    free_bytes = shutil.disk_usage(folder.parent.parent).free
    assert refused(folder, body(b"x"), min_free_bytes=free_bytes * 2).code == "disk-full"
    error = refused(folder, body(b"x"), min_free_bytes=0, max_bytes=1 << 62, expected_bytes=free_bytes * 2)
    assert (error.status, error.code) == (507, "disk-full")
    assert "bytes are free" in error.problem.detail


FULL = """
import asyncio, resource, sys
from pathlib import Path
from service.errors import ServiceError
from service.storage.spool import receive

async def body():
    for _ in range(64):
        yield bytes(1 << 16)

async def main():
    await receive(body(), Path(sys.argv[1]), max_bytes=1 << 30, expected_bytes=None, expected_sha256=None,
                  min_free_bytes=0, on_disk=asyncio.Semaphore(1))

if sys.argv[2:]:
    resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv[2]), int(sys.argv[2])))
try:
    asyncio.run(main())
except ServiceError as error:
    print(error.status, error.code, error.problem.detail, list(Path(sys.argv[1]).iterdir()))
"""


def test_the_system_takes_no_more_bytes(folder: Path) -> None:
    done = subprocess.run([sys.executable, "-c", FULL, folder, "2500000"], capture_output=True, text=True, timeout=120)
    assert done.stdout.startswith("507 disk-full"), done.stderr
    assert os.strerror(errno.EFBIG) in done.stdout
    assert done.stdout.endswith("[]\n")


def test_a_disk_that_is_really_full(tmp_path: Path) -> None:
    mount = f"mount -t tmpfs -o size=2m none {tmp_path} && exec {sys.executable} -c '{FULL}' {tmp_path}/spool"
    isolated = ["unshare", "--user", "--map-root-user", "--mount"]
    if shutil.which("unshare") is None or subprocess.run([*isolated, "true"], capture_output=True).returncode:
        pytest.skip("this system lets ordinary users mount nothing")
    done = subprocess.run([*isolated, "sh", "-c", mount], capture_output=True, text=True, timeout=120)
    assert done.stdout.startswith("507 disk-full"), done.stderr
    assert done.stdout.endswith("[]\n")


def test_a_client_that_goes_away(folder: Path) -> None:
    messages = iter(
        [
            {"type": "http.request", "body": bytes(2 * BATCH_BYTES), "more_body": True},
            {"type": "http.request", "body": b"more", "more_body": True},
            {"type": "http.disconnect"},
        ]
    )

    async def incoming() -> Any:
        return next(messages)

    request = Request({"type": "http", "method": "PUT", "headers": []}, incoming)
    with pytest.raises(ClientDisconnect):
        receive_now(request.stream(), folder)
    assert list(folder.iterdir()) == []


@pytest.mark.parametrize("by", ["task", "scope"])
def test_a_cancelled_task_leaves_nothing(folder: Path, by: str) -> None:
    async def run() -> None:
        wrote = asyncio.Event()

        async def stalled() -> AsyncIterator[bytes]:
            yield bytes(2 * BATCH_BYTES)
            wrote.set()
            await asyncio.sleep(3600)

        async def upload() -> None:
            with scope:
                await receive(
                    stalled(),
                    folder,
                    max_bytes=1 << 30,
                    expected_bytes=None,
                    expected_sha256=None,
                    min_free_bytes=0,
                    on_disk=asyncio.Semaphore(1),
                )

        scope = anyio.CancelScope()
        task = asyncio.create_task(upload())
        await wrote.wait()
        assert len(list(folder.iterdir())) == 1
        if by == "task":
            task.cancel()
            with pytest.raises(asyncio.CancelledError):
                await task
        else:
            scope.cancel()
            await task
        assert list(folder.iterdir()) == []

    asyncio.run(run())


def test_a_write_in_flight_ends_before_its_file_is_closed(folder: Path) -> None:
    """A thread that went on writing after the file was closed would write into another upload's file."""
    writer = SpoolWriter(folder, min_free_bytes=0)
    threads = [threading.Thread(target=writer.write, args=(bytes(1 << 22),)) for _ in range(4)]
    for thread in threads:
        thread.start()
    writer.discard()
    other = SpoolWriter(folder, min_free_bytes=0)
    for thread in threads:
        thread.join()
    with other.finish(b"mine") as spooled:
        assert spooled.path.read_bytes() == b"mine"
    assert list(folder.iterdir()) == []


def test_memory_is_constant(folder: Path) -> None:
    async def large() -> AsyncIterator[bytes]:
        for _ in range(64 * 16):
            yield bytes(1 << 16)

    tracemalloc.start()
    try:
        receive_now(large(), folder, max_bytes=1 << 30).discard()
        peak_bytes = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert BATCH_BYTES < peak_bytes < 12 * BATCH_BYTES  # of 64; a slow disk lets some wait


def test_what_a_killed_process_left_is_swept(folder: Path) -> None:
    script = (
        "import sys, os, signal; from pathlib import Path; from service.storage.spool import SpoolWriter;"
        "SpoolWriter(Path(sys.argv[1]), min_free_bytes=0).write(b'half'); os.kill(os.getpid(), signal.SIGKILL)"
    )
    done = subprocess.run([sys.executable, "-c", script, folder], timeout=120)
    assert done.returncode == -signal.SIGKILL
    (leftover,) = folder.iterdir()
    (folder / "somebody-elses.part").write_bytes(b"")
    (folder / "unfinished").mkdir()
    assert sweep(folder, older_than_s=3600) == 0
    os.utime(leftover, (0, 0))
    os.utime(folder / "somebody-elses.part", (0, 0))
    assert sweep(folder, older_than_s=3600) == 1
    assert {path.name for path in folder.iterdir()} == {"somebody-elses.part", "unfinished"}
    assert sweep(folder / "missing", older_than_s=1) == 0


def test_other_errors_of_the_disk_are_not_the_clients(folder: Path) -> None:
    folder.parent.mkdir(parents=True)
    folder.write_bytes(b"a file where the folder should be")
    with pytest.raises(NotADirectoryError):
        receive_now(body(b"x"), folder)


def test_the_spools_files_do_not_leak_descriptors(folder: Path) -> None:
    before = len(os.listdir("/proc/self/fd"))
    for _ in range(20):
        receive_now(body(b"x"), folder).discard()
        refused(folder, body(b"x"), expected_bytes=2)
    assert len(os.listdir("/proc/self/fd")) <= before + 2


EMPTY_BASE64 = "47DEQpj8HBSa+/TImW+5JCeuQeRkm5NMpJWZG3hSuFU="


@pytest.mark.parametrize(
    ("fields", "digest"),
    [
        ([], None),
        ([f"sha-256=:{EMPTY_BASE64}:"], EMPTY_SHA256),
        ([f"sha-256=:{EMPTY_BASE64.rstrip('=')}:"], EMPTY_SHA256),
        ([f" md5=:AAAA:,\tsha-256=:{EMPTY_BASE64}:;q=1 , sha-512=:AAAA:"], EMPTY_SHA256),
        (["sha-512=:AAAA:", f"sha-256=:{EMPTY_BASE64}:"], EMPTY_SHA256),
        ([f"sha-256=:{EMPTY_BASE64}:", f"sha-256=:{EMPTY_BASE64}:"], EMPTY_SHA256),
    ],
)
def test_digest_fields(fields: list[str], digest: str | None) -> None:
    assert parse_digest(*fields) == digest


@pytest.mark.parametrize(
    ("header", "word"),
    [
        ("", "form"),
        (EMPTY_SHA256, "form"),
        (f"SHA-256=:{EMPTY_BASE64}:", "form"),
        (f"sha-256={EMPTY_BASE64}", "form"),
        (f"sha-256=:{EMPTY_BASE64}:,", "form"),
        ("sha-256=:AAAA:", "32 bytes, not 3"),
        ("sha-256=:A:", "base64"),
        ("sha-256=:ä:", "form"),
        (f"sha-256=:{EMPTY_BASE64}:, sha-256=:{'A' * 43}=:", "different values"),
        ("sha-512=:AAAA:", "does not give sha-256"),
        ("sha-256=:" + "A" * 100_000 + ":", "32 bytes"),
    ],
)
def test_malformed_digest_fields(header: str, word: str) -> None:
    with pytest.raises(ServiceError, match=word) as caught:
        parse_digest(header)
    assert (caught.value.status, caught.value.code) == (400, "malformed-digest")
    assert len(caught.value.problem.detail) < 250


def test_digests_are_written_as_they_are_read() -> None:
    assert format_digest(EMPTY_SHA256) == f"sha-256=:{EMPTY_BASE64}:"
    assert parse_digest(format_digest("ab" * 32)) == "ab" * 32
