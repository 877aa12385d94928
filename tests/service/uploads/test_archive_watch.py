"""Archives whose names are read while the bytes come."""

from __future__ import annotations

import gzip
import io
import tarfile
import zipfile
from collections.abc import Sequence
from pathlib import Path

import pytest

from schemas.file_names import composed
from service.errors import ServiceError
from service.storage.uploads.archive_watch import ArchiveWatch, KeptWatches
from tests.service.uploads.test_archive import EXPECTED, PACKERS, Members, Pack, png, streamed_zip_of, tar_of, zip_of
from tests.service.uploads.test_archive_tar import header, member, pax

LONG = f"front/{'a' * 150}.png"
PIECE_BYTES = 1000
PNG_BYTES = 20_000


def watch() -> ArchiveWatch:
    named = {composed(name) for name in (*EXPECTED, LONG)} | {"drive.json"}

    def known(paths: Sequence[str]) -> set[str]:
        return {path for path in paths if composed(path) in named}

    return ArchiveWatch(known, len(EXPECTED), max_ratio=200.0)


def received(path: Path, data: bytes, watching: ArchiveWatch | None = None) -> int:
    """Bytes that came until the archive was refused; the refusal is raised again with them in `args`."""
    watching = watching or watch()
    with path.open("wb") as stream:
        for at in range(0, len(data), PIECE_BYTES):
            stream.write(data[at : at + PIECE_BYTES])
            stream.flush()
            try:
                watching.look(path)
            except ServiceError as error:
                error.args = (stream.tell(),)
                raise
    return len(data)


def refused(path: Path, data: bytes, code: str, *words: str) -> int:
    """As `received`, of an archive that is refused."""
    with pytest.raises(ServiceError) as caught:
        received(path, data)
    assert caught.value.code == code
    for word in words:
        assert word in caught.value.problem.detail
    assert caught.value.problem.remedy
    return int(caught.value.args[0])


def outcome(path: Path, data: bytes) -> str:
    """Code of the refusal; empty where there is none."""
    try:
        received(path, data)
    except ServiceError as error:
        return error.code
    return ""


def images(*names: str) -> Members:
    return [(name, png(filler=PNG_BYTES)) for name in names]


@pytest.fixture(params=list(PACKERS))
def kind(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.fixture
def pack(kind: str) -> Pack:
    return PACKERS[kind]


def ahead_of(kind: str) -> int:
    """Bytes that a compressor keeps together: nothing of them can be read before the last has come."""
    return 900_000 if kind == "tar bzip2" else 0


@pytest.mark.parametrize("prefix", ["", "my drive/"])
def test_what_belongs_to_the_drive_is_not_refused(tmp_path: Path, pack: Pack, prefix: str) -> None:
    names = [*EXPECTED, "drive.json", ".DS_Store", "__MACOSX/._x", "truth.tum", "truth_own_car/front.png"]
    names.append(".mrasfm-upload.json")
    data = pack(images(*(prefix + name for name in names)))
    assert received(tmp_path / "archive", data) == len(data)


def test_a_strange_file_is_refused_before_the_next_ones_come(tmp_path: Path, kind: str, pack: Pack) -> None:
    names = ["front/0.png", "front/1.png", "notes/mine.txt", *(f"front/{n}.png" for n in range(2, 80))]
    data = pack(images(*names))
    came = refused(tmp_path / "archive", data, "unexpected-file", "notes/mine.txt")
    assert came < 10 * PNG_BYTES + ahead_of(kind) < 0.75 * len(data)


def test_a_name_that_leaves_the_drive(tmp_path: Path, kind: str, pack: Pack) -> None:
    name = "../../etc/passwd"
    data = pack(images("front/0.png", name, *(f"front/{n}.png" for n in range(1, 80))))
    came = refused(tmp_path / "archive", data, "unsafe-archive", name)
    assert came < 8 * PNG_BYTES + ahead_of(kind) < 0.75 * len(data)


@pytest.mark.parametrize("tar_format", [tarfile.PAX_FORMAT, tarfile.GNU_FORMAT])
def test_long_names_of_a_tar(tmp_path: Path, tar_format: int) -> None:
    data = tar_of(images(LONG, "front/0.png"), tar_format=tar_format)
    assert received(tmp_path / "archive", data) == len(data)
    strange = tar_of(images(LONG.replace("a", "b"), "front/0.png"), tar_format=tar_format)
    assert refused(tmp_path / "archive", strange, "unexpected-file", "bbbb") < PNG_BYTES


def test_a_link_in_a_tar(tmp_path: Path) -> None:
    stream = io.BytesIO()
    with tarfile.open(fileobj=stream, mode="w") as archive:
        member = tarfile.TarInfo("front/0.png")
        member.type, member.linkname = tarfile.SYMTYPE, "/etc/passwd"
        archive.addfile(member)
        member = tarfile.TarInfo("front/1.png")
        member.size = PNG_BYTES
        archive.addfile(member, io.BytesIO(bytes(PNG_BYTES)))
    assert refused(tmp_path / "archive", stream.getvalue(), "unsafe-archive", "a symbolic link") < PNG_BYTES


@pytest.mark.parametrize("size", ["²", "٣", "9" * 20, "9" * 4500, "1e3", ""])
def test_a_size_of_a_tar_that_is_no_number(tmp_path: Path, size: str) -> None:
    data = member(b"PaxHeader", pax(size=size), b"x") + member() + bytes(1024)
    refused(tmp_path / "archive", data, "damaged-archive", "'front/0.png'", "not a number")


def test_a_size_of_a_tar_in_an_extended_header(tmp_path: Path) -> None:
    strange = member(b"mine.txt")
    data = member(b"PaxHeader", pax(size="1000"), b"x") + header(size=0) + bytes(1024) + strange + bytes(1024)
    refused(tmp_path / "archive", data, "unexpected-file", "mine.txt")


def test_what_is_no_archive(tmp_path: Path) -> None:
    assert refused(tmp_path / "archive", b"no archive" * 1000, "not-an-archive") <= PIECE_BYTES


@pytest.mark.parametrize("has_signature", [True, False])
def test_a_stored_archive_within_a_stored_entry_without_sizes(tmp_path: Path, has_signature: bool) -> None:
    """The entry ends at its own descriptor, not at one of its content; a descriptor may have no signature."""
    inner = streamed_zip_of(images("inner/0.png", "inner/1.png"), zipfile.ZIP_STORED, has_long_sizes=False)
    names = ["front/1.png", "notes/mine.txt", *(f"front/{n}.png" for n in range(2, 80))]
    members: Members = [("front/0.png", inner), *images(*names)]
    data = streamed_zip_of(members, zipfile.ZIP_STORED, has_long_sizes=False)
    if not has_signature:
        head, _, rest = data.partition(inner)
        data = head + inner + rest.replace(b"PK\x07\x08", b"")
    came = refused(tmp_path / "archive", data, "unexpected-file", "notes/mine.txt")
    assert len(inner) + PNG_BYTES < came < len(inner) + 4 * PNG_BYTES < 0.5 * len(data)


def test_a_stored_entry_whose_end_nothing_says(tmp_path: Path) -> None:
    """The whole archive is checked all the same."""
    data = bytearray(zip_of(images("front/0.png", "mine.txt"), zipfile.ZIP_STORED))
    data[6] |= 8
    data[18:26] = bytes(8)
    assert received(tmp_path / "archive", bytes(data)) == len(data)


@pytest.mark.parametrize("pack_badly", [lambda m: gzip.compress(tar_of(m)), streamed_zip_of])
def test_what_unpacks_to_too_much_is_not_unpacked(tmp_path: Path, pack_badly: Pack) -> None:
    refused(tmp_path / "archive", pack_badly([("front/0.png", bytes(50_000_000))]), "archive-too-large")


@pytest.mark.parametrize("at", [5, 700, 1500])
def test_damage_is_left_to_the_check_of_the_whole(tmp_path: Path, pack: Pack, at: int) -> None:
    data = bytearray(pack(images("front/0.png", "front/1.png")))
    data[at : at + 3] = b"\xff\xff\xff"
    code = outcome(tmp_path / "archive", bytes(data))
    assert code in ("", "unexpected-file", "unsafe-archive", "not-an-archive", "archive-too-large")


def test_watches_are_kept_within_a_bound() -> None:
    kept, watches = KeptWatches(most=2), [watch() for _ in range(3)]
    for number, one in enumerate(watches):
        kept.put(str(number), one)
    assert [kept.take(str(number)) for number in range(3)] == [None, *watches[1:]]
    assert kept.take("1") is None
