from __future__ import annotations

import errno
import hashlib
import json
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mrasfm_engine.errors import StorageError
from mrasfm_engine.io.stage_store import StageStore, StoredStage, content_sha256_of, drive_fingerprint, fingerprint
from mrasfm_engine.preflight.drive_reader import read_drive

ARRAYS: dict[str, np.ndarray] = {
    "descriptors": np.random.default_rng(0).integers(0, 256, (40, 128), dtype=np.uint8),
    "poses": np.random.default_rng(1).normal(size=(5, 4, 4)),
    "empty": np.zeros((0, 2), np.int32),
    "flags": np.array([True, False]),
    "number": np.array(7),
}
REPORT = {"images": 5, "rejected": {"few matches": 3}, "files": ["a b.png", "ü.png"], "seconds": 0.25, "none": None}


@pytest.fixture
def store(tmp_path: Path) -> StageStore:
    result = StageStore(tmp_path / ".stages")
    result.save("features", "key", ARRAYS, REPORT)
    return result


def file_of(tmp_path: Path) -> Path:
    return tmp_path / ".stages" / "features.npz"


def assert_parts_are_the_same(opened: StoredStage | None) -> None:
    assert opened is not None
    assert opened.report == REPORT
    for name, expected in ARRAYS.items():
        np.testing.assert_array_equal(opened.read(name), expected)
        assert opened.read(name).dtype == expected.dtype
        if expected.ndim:
            middle = len(expected) // 2
            np.testing.assert_array_equal(opened.rows(name, middle, None), expected[middle:])


def assert_same(found: tuple[dict[str, Any], dict[str, Any]] | None) -> None:
    assert found is not None
    arrays, report = found
    assert report == REPORT
    assert set(arrays) == set(ARRAYS)
    for name, expected in ARRAYS.items():
        np.testing.assert_array_equal(arrays[name], expected)
        assert arrays[name].dtype == expected.dtype


def test_a_stage_comes_back_as_it_was_saved(store: StageStore, tmp_path: Path) -> None:
    assert_same(store.load("features", "key"))
    assert_same(StageStore(tmp_path / ".stages").load("features", "key"))
    assert [p.name for p in (tmp_path / ".stages").iterdir()] == ["features.npz"]


def test_parts_of_a_stage_are_read_from_its_file(store: StageStore, tmp_path: Path) -> None:
    opened = store.open("features", "key")
    assert_parts_are_the_same(opened)
    assert store.open("features", "other") is None
    assert store.open("matches", "key") is None
    store.save("features", "newer", {"poses": np.ones(3)}, {})
    assert_parts_are_the_same(opened)


def test_a_stage_written_in_parts_counts_when_it_is_finished(tmp_path: Path) -> None:
    store = StageStore(tmp_path / ".stages")
    with store.writing("features", "key") as writer:
        for name, array in ARRAYS.items():
            writer.add(name, array)
            assert store.load("features", "key") is None
            assert store.open("features", "key") is None
        writer.finish(REPORT)
    assert_same(store.load("features", "key"))
    assert [p.name for p in (tmp_path / ".stages").iterdir()] == ["features.npz"]


@pytest.mark.parametrize("error", [ValueError(), KeyboardInterrupt()])
def test_a_stage_that_is_not_finished_leaves_nothing(store: StageStore, tmp_path: Path, error: BaseException) -> None:
    def half() -> None:
        with store.writing("features", "newer") as writer:
            writer.add("poses", ARRAYS["poses"])
            raise error

    with pytest.raises(type(error)):
        half()
    assert_same(store.load("features", "key"))
    assert [p.name for p in (tmp_path / ".stages").iterdir()] == ["features.npz"]


def test_what_a_killed_run_left_is_removed_by_the_next(store: StageStore, tmp_path: Path) -> None:
    """But not what another run is writing at this moment, nor what belongs to another stage."""
    folder = tmp_path / ".stages"
    orphan, other = folder / ".features.0123.partial", folder / ".matches.0123.partial"
    for path in (orphan, other):
        path.write_bytes(b"half of it")
    with store.writing("features", "first") as first, store.writing("features", "second") as second:
        assert not orphan.exists()
        assert other.exists()
        second.finish({"run": "second"})
        first.finish({"run": "first"})
    assert store.load("features", "first") == ({}, {"run": "first"})
    assert sorted(path.name for path in folder.iterdir()) == [".matches.0123.partial", "features.npz"]


def test_another_fingerprint_or_name_finds_nothing(store: StageStore, tmp_path: Path) -> None:
    assert store.load("features", "other") is None
    assert store.load("matches", "key") is None
    assert StageStore(tmp_path / "nowhere").load("features", "key") is None
    assert not (tmp_path / "nowhere").exists()


def test_saving_again_replaces(store: StageStore) -> None:
    store.save("features", "newer", {"a": np.ones(3)}, {})
    assert store.load("features", "key") is None
    found = store.load("features", "newer")
    assert found is not None
    np.testing.assert_array_equal(found[0]["a"], np.ones(3))


def test_a_truncated_file_counts_as_not_finished(store: StageStore, tmp_path: Path) -> None:
    whole = file_of(tmp_path).read_bytes()
    for length in [*range(0, 40), *range(40, len(whole), 97), len(whole) - 1]:
        file_of(tmp_path).write_bytes(whole[:length])
        assert store.load("features", "key") is None, length
        assert store.open("features", "key") is None, length
    file_of(tmp_path).write_bytes(whole)
    assert_same(store.load("features", "key"))


def test_a_corrupt_file_is_never_taken_for_a_result(store: StageStore, tmp_path: Path) -> None:
    """One wrong byte anywhere: nothing is found, or exactly what was saved where the byte does not matter."""
    whole = bytearray(file_of(tmp_path).read_bytes())
    rng = np.random.default_rng(0)
    structure = [k for k in range(len(whole)) if k < 200 or k > len(whole) - 500]
    found_nothing = 0
    for k in [*structure, *rng.integers(0, len(whole), 150).tolist()]:
        damaged = bytearray(whole)
        damaged[k] ^= 0xFF
        file_of(tmp_path).write_bytes(damaged)
        found = store.load("features", "key")
        if (opened := store.open("features", "key")) is not None:
            assert_parts_are_the_same(opened)
        if found is None:
            found_nothing += 1
        else:
            assert_same(found)
    assert found_nothing > 250


@pytest.mark.parametrize(
    ("there", "instead"),
    [
        (b"'shape': (5000, 4)", b"'shape': (4000, 4)"),
        (b"'shape': (5000, 4)", b"'shape': (5000,3 )"),
        (b"NUMPY\x01\x00\x76\x00{'descr': '<f8'", b"NUMPY\x01\x00\x74\x00{'descr': '<f8'"),  # its own length
    ],
)
def test_an_array_that_seems_shorter_is_never_taken_for_a_result(tmp_path: Path, there: bytes, instead: bytes) -> None:
    """numpy reads as much as the array's head asks for, and zipfile compares the checksum at the end alone."""
    store = StageStore(tmp_path / ".stages")
    store.save("features", "key", {"positions": np.ones((5000, 4))}, REPORT)
    whole = file_of(tmp_path).read_bytes()
    assert whole.count(there) == 1
    file_of(tmp_path).write_bytes(whole.replace(there, instead))
    assert store.load("features", "key") is None
    assert store.open("features", "key") is None


@pytest.mark.parametrize("content", [b"", b"not a zip", b"PK\x03\x04", b"\x93NUMPY", bytes(1000)])
def test_something_else_under_that_name_is_ignored(store: StageStore, tmp_path: Path, content: bytes) -> None:
    file_of(tmp_path).write_bytes(content)
    assert store.load("features", "key") is None


def test_a_plain_array_or_a_folder_under_that_name_is_ignored(store: StageStore, tmp_path: Path) -> None:
    with file_of(tmp_path).open("wb") as stream:
        np.save(stream, np.ones(3))
    assert store.load("features", "key") is None
    file_of(tmp_path).unlink()
    file_of(tmp_path).mkdir()
    assert store.load("features", "key") is None


@pytest.mark.parametrize("header", ["[]", "{}", "3", '{"key": "key"}', "{not json"])
def test_a_strange_header_is_ignored(store: StageStore, tmp_path: Path, header: str) -> None:
    np.savez(file_of(tmp_path), header=np.array(header), a=np.ones(2))
    assert store.load("features", "key") is None


@pytest.mark.parametrize("error", [OSError(errno.ENOSPC, "No space left on device"), KeyboardInterrupt()])
def test_an_interrupted_save_leaves_the_old_file_and_no_rest(
    store: StageStore, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: BaseException
) -> None:
    def fail(file: Any, array: Any, **options: Any) -> None:
        file.write(b"half of it")
        raise error

    monkeypatch.setattr(np.lib.format, "write_array", fail)
    with pytest.raises(StorageError if isinstance(error, OSError) else KeyboardInterrupt):
        store.save("features", "newer", {"a": np.ones(3)}, {})
    monkeypatch.undo()
    assert_same(store.load("features", "key"))
    assert [p.name for p in (tmp_path / ".stages").iterdir()] == ["features.npz"]


def test_a_full_disk_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(fd: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(StorageError, match=r"no space left to write .*features\.npz"):
        StageStore(tmp_path / ".stages").save("features", "key", ARRAYS, REPORT)
    assert not list((tmp_path / ".stages").iterdir())


def test_where_nothing_can_be_written_that_is_said(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(StorageError, match="cannot write") as caught:
        StageStore(tmp_path / "file" / ".stages").save("features", "key", ARRAYS, REPORT)
    assert caught.value.code == "storage"
    assert (tmp_path / "file").read_text() == "in the way"


def test_fingerprints_tell_inputs_apart() -> None:
    assert fingerprint("a", {"x": 1, "y": 2}) == fingerprint("a", {"y": 2, "x": 1})
    different = [("a",), ("b",), ("a", 1), ("a", "1"), ("a", None), (["a"],), ("ab",), ("a", "b")]
    assert len({fingerprint(*parts) for parts in different}) == len(different)


def of(folder: Path, contents: dict[str, str] | None = None) -> str:
    drive = read_drive(folder)
    return drive_fingerprint(drive, content_sha256_of(drive, threads=2) if contents is None else contents)


def test_the_drives_fingerprint_follows_contents_and_manifest(write_drive: Any, drive_document: Any) -> None:
    folder = write_drive(drive_document)
    first = of(folder)
    image = next((folder / "images").rglob("*.png"))
    times = image.stat()
    os.utime(image, ns=(1, 1))
    assert of(folder) == first, "a file that was copied or restored is the same input"
    data = bytearray(image.read_bytes())
    data[-1] ^= 1
    image.write_bytes(data)
    os.utime(image, ns=(times.st_atime_ns, times.st_mtime_ns))
    changed = of(folder)
    assert changed != first, "other bytes of the same size and time are another input"
    drive_document["rig"]["cameras"][0]["params"][0] += 0.001
    (folder / "drive.json").write_text(json.dumps(drive_document), encoding="utf-8")
    assert of(folder) not in {first, changed}


def test_digests_that_the_caller_knows_stand_for_the_files(write_drive: Any, drive_document: Any) -> None:
    folder = write_drive(drive_document)
    read = of(folder)
    names = [path.relative_to(folder).as_posix() for path in (folder / "images").rglob("*.png")]
    contents = {name: hashlib.sha256((folder / name).read_bytes()).hexdigest() for name in names}
    for name in names:
        (folder / name).unlink()
    assert of(folder, contents) == read
    assert of(folder, {**contents, names[0]: "0" * 64}) != read
