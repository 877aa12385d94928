"""Archives that are fine, and what is refused in zip and tar alike."""

from __future__ import annotations

import bz2
import gzip
import hashlib
import io
import json
import lzma
import os
import random
import shutil
import struct
import tarfile
import zipfile
import zlib
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from service.errors import ServiceError
from service.storage.spool import Spooled
from service.storage.uploads.archive import ArchiveLimits, unpack

LIMITS: dict[str, Any] = {
    "max_entries": 1000,
    "max_bytes": 100_000_000,
    "max_ratio": 200.0,
    "max_file_bytes": 50_000_000,
    "min_free_bytes": 0,
}
MANIFEST = {"version": 1, "name": "the drive"}
EXPECTED = ("front/0.png", "front/1.png", "back/0.png", "köln/straße.png")

Members = Iterable[tuple[str, bytes]]
Pack = Callable[[Members], bytes]


def png(width: int = 4, height: int = 3, filler: int = 0) -> bytes:
    """A PNG whose header is sound; the filler makes it as long as an image of a camera."""
    chunks = [
        (b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)),
        (b"IDAT", zlib.compress(bytes(20)) + os.urandom(filler)),
        (b"IEND", b""),
    ]
    packed = [struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
              for kind, data in chunks]  # fmt: skip
    return b"\x89PNG\r\n\x1a\n" + b"".join(packed)


def zip_of(members: Members, method: int = zipfile.ZIP_DEFLATED) -> bytes:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", method) as archive:
        for name, data in members:
            archive.writestr(zipfile.ZipInfo(name), data, method)
    return stream.getvalue()


def tar_of(members: Members, mode: str = "w", tar_format: int = tarfile.PAX_FORMAT) -> bytes:
    stream = io.BytesIO()
    with tarfile.open(fileobj=stream, mode=mode, format=tar_format) as archive:
        for name, data in members:
            member = tarfile.TarInfo(name)
            member.size = len(data)
            if name.endswith("/"):
                member.type = tarfile.DIRTYPE
            archive.addfile(member, io.BytesIO(data))
    return stream.getvalue()


def streamed_zip_of(members: Members, compression: int = zipfile.ZIP_DEFLATED, *, has_long_sizes: bool = True) -> bytes:
    """As `zip -` writes to a pipe: sizes come behind the content."""

    class Pipe(io.RawIOBase):
        data = b""

        def writable(self) -> bool:
            return True

        def write(self, data: Any) -> int:
            self.data += bytes(data)
            return len(data)

    pipe = Pipe()
    with zipfile.ZipFile(pipe, "w", compression) as archive:
        for name, data in members:
            with archive.open(name, "w", force_zip64=has_long_sizes) as entry:
                entry.write(data)
    return pipe.data


PACKERS: dict[str, Pack] = {
    "zip stored": lambda members: zip_of(members, zipfile.ZIP_STORED),
    "zip deflated": zip_of,
    "zip streamed": streamed_zip_of,
    "zip streamed stored": lambda members: streamed_zip_of(members, zipfile.ZIP_STORED, has_long_sizes=False),
    "zip streamed stored, long": lambda members: streamed_zip_of(members, zipfile.ZIP_STORED),
    "tar pax": tar_of,
    "tar gnu": lambda members: tar_of(members, tar_format=tarfile.GNU_FORMAT),
    "tar ustar": lambda members: tar_of(members, tar_format=tarfile.USTAR_FORMAT),
    "tar gzip": lambda members: tar_of(members, "w:gz"),
    "tar bzip2": lambda members: tar_of(members, "w:bz2"),
    "tar xz": lambda members: tar_of(members, "w:xz"),
}
ZIP_AND_TAR = {"zip": zip_of, "tar": tar_of}


@pytest.fixture(params=list(PACKERS))
def pack(request: pytest.FixtureRequest) -> Pack:
    return PACKERS[request.param]


@pytest.fixture(params=list(ZIP_AND_TAR))
def pack_plainly(request: pytest.FixtureRequest) -> Pack:
    return ZIP_AND_TAR[request.param]


class Unpacker:
    """Unpacks bytes into a spool folder; where that fails, the folder must be empty."""

    def __init__(self, root: Path) -> None:
        self.folder = root / "spool"
        self.folder.mkdir()
        self._archive = root / "archive"

    def __call__(self, data: bytes, expected: Iterable[str] = EXPECTED, **limits: Any) -> dict[str, bytes]:
        files = self.spooled(data, expected, **limits)
        assert {file.path for _, file in files} == set(self.folder.iterdir())
        result = {}
        for name, file in files:
            result[name] = file.path.read_bytes()
            assert file.sha256 == hashlib.sha256(result[name]).hexdigest()
            assert file.size_bytes == len(result[name])
        for _, file in files:  # equal contents share one
            file.discard()
        assert len(result) == len(files)
        return result

    def spooled(self, data: bytes, expected: Iterable[str], **limits: Any) -> list[tuple[str, Spooled]]:
        self._archive.write_bytes(data)
        return unpack(
            self._archive,
            list(expected),
            folder=self.folder,
            limits=ArchiveLimits(**(LIMITS | limits)),
            same_manifest=lambda raw: json.loads(raw) == MANIFEST,
        )

    def refused(self, data: bytes, code: str, *words: str, status: int = 422, **limits: Any) -> ServiceError:
        with pytest.raises(ServiceError) as caught:
            self(data, **limits)
        error = caught.value
        assert (error.status, error.code) == (status, code), error
        for word in words:
            assert word in error.problem.detail
        assert len(error.problem.detail) < 1000
        assert error.problem.remedy
        assert list(self.folder.iterdir()) == []
        return error

    def outcome(self, data: bytes) -> tuple[int, dict[str, bytes]]:
        """Status and files."""
        try:
            return 200, self(data)
        except ServiceError as error:
            return error.status, {}


@pytest.fixture
def unpacked(tmp_path: Path) -> Unpacker:
    return Unpacker(tmp_path)


def test_files_come_out_as_they_went_in(unpacked: Unpacker, pack: Pack) -> None:
    members = {name: png(filler=300_000 * i) for i, name in enumerate(EXPECTED)}
    assert unpacked(pack(members.items())) == members


def test_some_files_of_the_drive_are_enough(unpacked: Unpacker, pack: Pack) -> None:
    assert list(unpacked(pack([("back/0.png", png())]))) == ["back/0.png"]


@pytest.mark.parametrize("prefix", ["", "./", "harbour-road/", "./harbour-road/", "front/"])
def test_litter_folders_and_one_top_folder_do_not_matter(unpacked: Unpacker, pack_plainly: Pack, prefix: str) -> None:
    data = png()
    members = [
        (prefix or "front/", b""),
        (f"{prefix}front/0.png", data),
        (f"{prefix}back/0.png", data),
        (f"{prefix}drive.json", json.dumps(MANIFEST, indent=4).encode()),
        (f"{prefix}front/.DS_Store", b"x"),
        (f"{prefix}front/._0.png", b"x"),
        (f"{prefix}Thumbs.db", b"x"),
        (f"{prefix}desktop.ini", b"x"),
        ("__MACOSX/harbour-road/front/._0.png", b"x"),
    ]
    assert unpacked(pack_plainly(members)) == {"front/0.png": data, "back/0.png": data}


def test_a_folder_of_the_drive_is_not_taken_for_the_top_folder(unpacked: Unpacker, pack_plainly: Pack) -> None:
    data = png()
    archive = pack_plainly([("front/0.png", data), ("front/1.png", data)])
    assert set(unpacked(archive, [*EXPECTED, "0.png", "1.png"])) == {"front/0.png", "front/1.png"}


def test_only_the_manifest(unpacked: Unpacker, pack_plainly: Pack) -> None:
    assert unpacked(pack_plainly([("drive.json", json.dumps(MANIFEST).encode())])) == {}


def test_names_of_macos_are_decomposed(unpacked: Unpacker, pack_plainly: Pack) -> None:
    assert list(unpacked(pack_plainly([("ko\u0308ln/straße.png", png())]))) == ["köln/straße.png"]


def test_long_names(unpacked: Unpacker, pack: Pack) -> None:
    name = "a" * 90 + "/" + "b" * 60 + ".png"  # ustar's fields of 100 and 155 bytes
    assert list(unpacked(pack([(name, png())]), [name])) == [name]


def test_another_manifest(unpacked: Unpacker, pack: Pack) -> None:
    members = [("front/0.png", png()), ("drive.json", b'{"version": 1, "name": "another"}')]
    unpacked.refused(pack(members), "other-manifest", "'drive.json'")


def test_a_manifest_that_is_too_large_for_memory(unpacked: Unpacker, pack_plainly: Pack) -> None:
    archive = pack_plainly([("top/drive.json", b" " * 5000)])
    unpacked.refused(archive, "archive-too-large", "'top/drive.json'", "bound of a manifest", max_manifest_bytes=4999)


def test_files_that_are_not_in_the_manifest(unpacked: Unpacker, pack: Pack) -> None:
    members = [("front/0.png", png()), *((f"extra/{i}.png", png()) for i in range(7))]
    error = unpacked.refused(pack(members), "unexpected-file", "7 files", "'extra/0.png'", "'extra/4.png'", "2 more")
    assert "extra/5.png" not in error.problem.detail


@pytest.mark.parametrize("top", ["", "my drive/"])
def test_what_our_commands_leave_beside_the_manifest_is_ignored(unpacked: Unpacker, pack: Pack, top: str) -> None:
    """As `mrasfm import`, `mrasfm synth` and `mrasfm upload` leave it in a drive's folder."""
    left = ("truth.tum", "truth_world.json", "truth_moving/front/0.png", ".mrasfm-upload.json")
    members = [(top + name, b"0 0 0 0 0 0 0 1") for name in left]
    assert list(unpacked(pack([*members, (f"{top}front/0.png", png())]))) == ["front/0.png"]
    unpacked.refused(
        pack([*members, (f"{top}front/truth.tum", b"1"), (f"{top}front/0.png", png())]),
        "unexpected-file",
        "front/truth.tum",
    )
    unpacked.refused(
        pack(members), "unexpected-file" if top else "empty-archive", "my drive/truth.tum" if top else "no file"
    )


def test_images_that_are_called_truth_are_the_drives(unpacked: Unpacker, pack: Pack) -> None:
    name = "truth_front/0.png"
    assert list(unpacked(pack([(name, png()), ("truth.tum", b"1")]), [name])) == [name]


def test_an_archive_without_files(unpacked: Unpacker, pack_plainly: Pack) -> None:
    unpacked.refused(pack_plainly([]), "empty-archive", "holds no file")
    unpacked.refused(pack_plainly([("front/", b""), ("__MACOSX/x", b"")]), "empty-archive", "holds no file")


@pytest.mark.parametrize(
    ("name", "word"),
    [
        ("../front/0.png", "'..'"),
        ("front/../../0.png", "'..'"),
        ("/etc/passwd", "absolute"),
        ("C:/front/0.png", "drive letter"),
        ("front\\0.png", "backslash"),
        ("..\\0.png", "backslash"),
        ("front/\n0.png", "control"),
        ("front/\x1b[2J.png", "control"),
        ("front/\u202egnp.0", "invisible"),
        ("front//0.png", "empty part"),
        ("front/./0.png", "'.'"),
        ("n" * 1025, "1025 bytes"),
        ("__MACOSX/../../0.png", "'..'"),
        ("../", "'..'"),
    ],
)
def test_names_that_are_refused(unpacked: Unpacker, pack_plainly: Pack, name: str, word: str) -> None:
    archive = pack_plainly([("front/0.png", png()), (name, b"")])
    error = unpacked.refused(archive, "unsafe-archive", word)
    assert error.problem.detail.isprintable()


@pytest.mark.parametrize(
    ("first", "second", "word"),
    [
        ("front/0.png", "front/0.png", "twice"),
        ("front/0.png", "Front/0.PNG", "same file"),
        ("köln/straße.png", "ko\u0308ln/straße.png", "same file"),
        ("köln/straße.png", "KO\u0308LN/STRASSE.png", "same file"),
    ],
)
@pytest.mark.filterwarnings("ignore:Duplicate name")
def test_names_for_the_same_file(unpacked: Unpacker, pack: Pack, first: str, second: str, word: str) -> None:
    archive = pack([(first, png()), ("front/1.png", png()), (second, png())])
    unpacked.refused(archive, "unsafe-archive", word)


@pytest.mark.parametrize(("kind", "entries"), [("zip stored", 20_000), ("tar gzip", 1_001)])
def test_too_many_entries(unpacked: Unpacker, kind: str, entries: int) -> None:
    archive = PACKERS[kind]((f"front/{i}.png", png()) for i in range(entries))
    unpacked.refused(archive, "archive-too-large", "entries, the bound is 1000")


def test_too_many_bytes(unpacked: Unpacker, pack: Pack) -> None:
    archive = pack([(name, png(filler=50_000)) for name in EXPECTED])
    unpacked.refused(archive, "archive-too-large", "over 200000 bytes", max_bytes=200_000)
    unpacked.refused(archive, "archive-too-large", "'front/0.png'", "bound of one file", max_file_bytes=40_000)
    assert len(unpacked(archive, max_bytes=300_000, max_file_bytes=60_000)) == len(EXPECTED)


def test_more_bytes_than_the_project_may_store(unpacked: Unpacker, pack: Pack) -> None:
    archive = pack([(name, png(filler=50_000)) for name in EXPECTED])
    words = ("have 20", "equal ones counted once; the project may store 200000")
    unpacked.refused(archive, "quota-full", *words, status=413, max_stored_bytes=200_000)
    unpacked.refused(archive, "quota-full", "'front/0.png'", status=413, max_stored_bytes=40_000)
    assert len(unpacked(archive, max_stored_bytes=300_000)) == len(EXPECTED)


def test_equal_files_take_space_once(unpacked: Unpacker, pack: Pack) -> None:
    """Masks of a vehicle that is always at the same place in the image are."""
    mask = png(filler=50_000)
    archive = pack([*((name, mask) for name in EXPECTED), ("drive.json", json.dumps(MANIFEST).encode())])
    files = unpacked.spooled(archive, EXPECTED, max_stored_bytes=len(mask))
    assert [name for name, _ in files] == list(EXPECTED)
    (path,) = unpacked.folder.iterdir()
    assert {file.path for _, file in files} == {path}
    path.unlink()
    assert unpacked(archive, max_stored_bytes=len(mask)) == dict.fromkeys(EXPECTED, mask)


@pytest.mark.parametrize("kind", ["zip deflated", "tar gzip", "tar bzip2", "tar xz"])
def test_a_compression_ratio_of_a_thousand(unpacked: Unpacker, kind: str) -> None:
    archive = PACKERS[kind]([("front/0.png", bytes(20_000_000))])
    assert len(archive) < 30_000
    unpacked.refused(archive, "archive-too-large", "compression ratio is over 200")


@pytest.mark.parametrize("kind", ["zip deflated", "tar gzip", "tar xz"])
def test_a_bomb_among_images(unpacked: Unpacker, kind: str) -> None:
    """The ratio of the archive as a whole is harmless."""
    members = [("front/0.png", png(filler=1_000_000)), ("front/1.png", bytes(45_000_000)), ("back/0.png", png())]
    unpacked.refused(PACKERS[kind](members), "archive-too-large", "'front/1.png'", "compression ratio")


@pytest.mark.parametrize("kind", ["zip deflated", "tar gzip"])
def test_a_bomb_of_small_files(unpacked: Unpacker, kind: str) -> None:
    """Each by itself is so small that its ratio does not matter."""
    archive = PACKERS[kind]((f"{i}/.DS_Store", bytes(60_000)) for i in range(300))
    unpacked.refused(archive, "archive-too-large", "the archive unpacks to", "compression ratio", max_ratio=100.0)


def test_the_disk_is_full(unpacked: Unpacker, pack: Pack) -> None:
    free_bytes = shutil.disk_usage(unpacked.folder).free
    archive = pack([("front/0.png", png())])
    unpacked.refused(archive, "disk-full", status=507, min_free_bytes=2 * free_bytes)


@pytest.mark.parametrize(
    ("data", "code", "word"),
    [
        (b"", "empty-file", "0 bytes"),
        (b"GIF89a" * 10, "not-an-image", "neither a JPEG nor a PNG"),
        (png()[:20], "damaged-image", "damaged"),
        (png(60_000, 60_000), "image-too-large", "60000x60000"),
    ],
)
def test_files_that_are_no_images(unpacked: Unpacker, pack: Pack, data: bytes, code: str, word: str) -> None:
    unpacked.refused(pack([("front/1.png", png()), ("front/0.png", data)]), code, word, "image front/0.png ")


NOISE = np.random.default_rng(0).bytes(5000)
NO_ARCHIVES = {
    "nothing": b"",
    "two bytes of a zip": b"PK",
    "7z": b"7z\xbc\xaf\x27\x1c" + bytes(1000),
    "rar": b"Rar!\x1a\x07\x00" + bytes(1000),
    "an image": png(),
    "noise": NOISE,
    "gzip of a text": gzip.compress(b"no tar"),
    "gzip of noise": gzip.compress(NOISE),
    "bzip2 of noise": bz2.compress(NOISE),
    "xz of noise": lzma.compress(NOISE),
    "gzip of a zip": gzip.compress(zip_of([("front/0.png", png())])),
}


@pytest.mark.parametrize("data", NO_ARCHIVES.values(), ids=NO_ARCHIVES.keys())
def test_what_is_no_archive(unpacked: Unpacker, data: bytes) -> None:
    error = unpacked.refused(data, "not-an-archive", status=415)
    assert "tar" in error.problem.remedy


def test_every_truncated_archive_is_refused(unpacked: Unpacker, pack: Pack) -> None:
    archive = pack([(name, png(filler=500)) for name in EXPECTED])
    end = len(archive.rstrip(b"\0")) if archive[257:262] == b"ustar" else len(archive)
    for size_bytes in {*range(1, end, max(1, end // 60)), end - 1}:
        assert unpacked.outcome(archive[:size_bytes])[0] in (415, 422)
        assert list(unpacked.folder.iterdir()) == []


def test_bytes_that_follow_the_archive(unpacked: Unpacker, pack: Pack) -> None:
    archive = pack([("front/0.png", png())])
    unpacked.refused(archive + b"garbage", "damaged-archive", "follow")


@pytest.mark.parametrize("kind", ["tar gzip", "tar bzip2", "tar xz"])
def test_compressed_in_pieces_and_padded(unpacked: Unpacker, kind: str) -> None:
    compress = {"tar gzip": gzip.compress, "tar bzip2": bz2.compress, "tar xz": lzma.compress}[kind]
    tar = tar_of([("front/0.png", png(filler=300_000))])
    pieces = b"".join(compress(tar[i : i + 100_000]) for i in range(0, len(tar), 100_000))
    assert list(unpacked(pieces + bytes(512))) == ["front/0.png"]
    assert list(unpacked(compress(b"") * 20 + compress(tar))) == ["front/0.png"]
    empty = compress(b"") * (1_200_000 // len(compress(b"")))
    unpacked.refused(empty + compress(tar), "damaged-archive", "too many pieces")


def test_damage_anywhere_never_does_harm(unpacked: Unpacker, pack: Pack) -> None:
    """Whatever byte is damaged: the true files, or a refusal with nothing left."""
    members = {name: png(filler=200) for name in EXPECTED}
    archive = pack(members.items())
    rng = random.Random(7)
    for _ in range(150):
        data = bytearray(archive)
        for _ in range(rng.choice((1, 1, 4))):
            data[rng.randrange(len(data))] = rng.randrange(256)
        status, found = unpacked.outcome(bytes(data))
        assert status in (200, 415, 422)
        assert set(found) <= set(members)
        if archive.startswith(b"PK"):  # zip has checksums of contents, tar has not
            assert all(found[name] == members[name] for name in found)
        assert list(unpacked.folder.iterdir()) == []
