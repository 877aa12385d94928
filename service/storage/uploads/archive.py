"""Unpacks an uploaded zip or tar archive into spool files: all that it holds, or nothing."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable
from pathlib import Path
from typing import BinaryIO

from schemas.file_names import MANIFEST_NAME, is_ignored
from service.errors import ArchiveTooLarge, OtherManifest
from service.storage.spool import Spooled, SpoolWriter
from service.storage.uploads.archive_errors import shown
from service.storage.uploads.archive_limits import ArchiveLimits, quota_too_small
from service.storage.uploads.archive_names import EntryNames, may_be_manifest
from service.storage.uploads.decompress import compression_of
from service.storage.uploads.images import check_image
from service.storage.uploads.tar_reader import read_tar
from service.storage.uploads.zip_reader import SIGNATURES, ZipReader

__all__ = ["ArchiveLimits", "SameManifest", "unpack"]

SameManifest = Callable[[bytes], bool]

_START_BYTES = 8


def unpack(
    archive: Path,
    expected: Collection[str],
    *,
    folder: Path,
    limits: ArchiveLimits,
    same_manifest: SameManifest,
) -> list[tuple[str, Spooled]]:
    """Unpack a received archive. It blocks for as long as that takes: call it in a thread.

    What kind of archive it is, its first bytes say: zip (stored and deflated entries), or tar, plain or compressed
    with gzip, bzip2 or xz. Folders and the files that operating systems leave behind are ignored; one top folder
    around all files does not count. Not all files of the drive need to be there.

    Parameters
    ----------
    archive
        The received file; it is left where it is.
    expected
        The files of the drive's manifest.
    folder
        Of the spool files.
    same_manifest
        Whether the bytes of a `drive.json` are the drive's manifest; such a file is checked, and not in the result.

    Returns
    -------
    list of (str, Spooled)
        The drive's files in the archive; those of equal content share one spool file. The caller owns the spool files.

    Raises
    ------
    ServiceError
        415 `not-an-archive`; 413 `quota-full`; 507 `disk-full`; else 422 that names the entry: `damaged-archive`,
        `unsupported-archive`, `unsafe-archive`, `archive-too-large`, `unexpected-file`, `other-manifest`,
        `empty-archive`, or what `check_image` refuses.
    """
    unpacking = _Unpacking(expected, folder, limits)
    try:
        with open(archive, "rb") as stream:
            start = stream.read(_START_BYTES)
            stream.seek(0)
            if start.startswith(SIGNATURES):
                _unpack_zip(stream, unpacking, limits)
            else:
                _unpack_tar(stream, compression_of(start), unpacking, limits)
        return unpacking.finish(same_manifest)
    except BaseException:
        unpacking.discard()
        raise


def _unpack_zip(stream: BinaryIO, unpacking: _Unpacking, limits: ArchiveLimits) -> None:
    archive = ZipReader(stream, limits)
    entries = [(name, info) for name, info in archive.entries if not is_ignored(name)]
    for name, _ in entries:
        unpacking.names.add(name)
    files = unpacking.names.resolve()  # before anything is unpacked
    for name, info in entries:
        if name in files:
            unpacking.write(name, info.file_size, archive.read(name, info))


def _unpack_tar(stream: BinaryIO, compression: str | None, unpacking: _Unpacking, limits: ArchiveLimits) -> None:
    for name, size_bytes, content in read_tar(stream, compression, limits):
        if not is_ignored(name) and unpacking.names.add(name):
            unpacking.write(name, size_bytes, content)


class _Unpacking:
    """The spool files of one archive."""

    def __init__(self, expected: Collection[str], folder: Path, limits: ArchiveLimits) -> None:
        self.names = EntryNames(expected)
        self._folder = folder
        self._limits = limits
        self._files: dict[str, Spooled] = {}
        self._contents: dict[str, Spooled] = {}  # images and masks by their digests
        self._stored_bytes = 0

    def write(self, name: str, size_bytes: int, content: Iterable[bytes]) -> None:
        """Unpack an entry, and check that it is an image."""
        if may_be_manifest(name) and size_bytes > self._limits.max_manifest_bytes:
            raise ArchiveTooLarge(
                f"entry {shown(name)} of the archive has {size_bytes} bytes, the bound of a manifest is "
                f"{self._limits.max_manifest_bytes}",
                remedy="Leave it out: the drive has its manifest.",
            )
        is_image = not may_be_manifest(name)
        if is_image:
            self._require_quota(name, size_bytes)
        writer = SpoolWriter(self._folder, min_free_bytes=self._limits.min_free_bytes)
        try:
            for chunk in content:
                writer.write(chunk)
            if is_image:
                check_image(writer.path, name)
            spooled = writer.finish()
            self._files[name] = self._once(name, spooled) if is_image else spooled
        except BaseException:
            writer.discard()
            raise

    def _once(self, name: str, spooled: Spooled) -> Spooled:
        """The first file with these bytes; another one is removed, as it takes no space of the quota either."""
        first = self._contents.setdefault(spooled.sha256, spooled)
        if first is not spooled:
            spooled.discard()
            return first
        self._stored_bytes += spooled.size_bytes
        self._require_quota(name, self._stored_bytes)
        return spooled

    def _require_quota(self, name: str, size_bytes: int) -> None:
        max_bytes = self._limits.max_stored_bytes
        if max_bytes is not None and size_bytes > max_bytes:
            raise quota_too_small(size_bytes, max_bytes, name)

    def finish(self, same_manifest: SameManifest) -> list[tuple[str, Spooled]]:
        """The drive's files by their names in it."""
        result = []
        for name, file in self.names.resolve().items():
            spooled = self._files[name]
            if file == MANIFEST_NAME:
                self._check_manifest(name, spooled, same_manifest)
                continue
            if may_be_manifest(name):  # an image that is called so
                check_image(spooled.path, name)
            result.append((file, spooled))
        return result

    def discard(self) -> None:
        """Remove everything that was unpacked."""
        for spooled in self._files.values():
            spooled.discard()

    def _check_manifest(self, name: str, spooled: Spooled, same_manifest: SameManifest) -> None:
        if not same_manifest(spooled.path.read_bytes()):
            raise OtherManifest(
                f"entry {shown(name)} of the archive is another manifest than the drive's",
                remedy="Leave it out to use the drive's manifest, or create a new drive with this one.",
            )
        spooled.discard()
