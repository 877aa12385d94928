"""Limits on an archive, and the counting against them."""

from __future__ import annotations

from dataclasses import dataclass

from service.errors import ArchiveTooLarge, QuotaFull, ServiceError
from service.storage.uploads.archive_errors import shown

# Below this nothing is a bomb, and short files of one colour compress a thousandfold.
SMALL_BYTES = 65_536


@dataclass(frozen=True, kw_only=True)
class ArchiveLimits:
    """Bounds of one archive.

    Parameters
    ----------
    max_entries
        Folders and files that are ignored count. Memory grows with it: some 1,000 bytes an entry.
    max_bytes
        Of all entries, unpacked.
    max_ratio
        Unpacked to packed bytes, of one entry and of the whole archive.
    max_file_bytes
        Of one entry, unpacked.
    min_free_bytes
        Of the disk, that must stay free.
    max_manifest_bytes
        Of the `drive.json` in the archive, which is read into memory.
    max_stored_bytes
        Of the drive's images and masks, unpacked, where equal ones count once: what their project may store.
    """

    max_entries: int
    max_bytes: int
    max_ratio: float
    max_file_bytes: int
    min_free_bytes: int
    max_manifest_bytes: int = 64_000_000
    max_stored_bytes: int | None = None


class Budget:
    """Counts entries and their bytes, as they are declared, against the limits."""

    def __init__(self, limits: ArchiveLimits) -> None:
        self._limits = limits
        self._entries = 0
        self._bytes = 0

    def entry(self, name: str | bytes, size_bytes: int) -> None:
        """Count one more entry.

        Raises
        ------
        ServiceError
            422 `archive-too-large`.
        """
        limits = self._limits
        self._entries += 1
        self._bytes += size_bytes
        if self._entries > limits.max_entries:
            raise too_many_entries(f"over {limits.max_entries}", limits.max_entries)
        if size_bytes > limits.max_file_bytes:
            raise ArchiveTooLarge(
                f"entry {shown(name)} of the archive has {size_bytes} bytes, the bound of one file is "
                f"{limits.max_file_bytes}",
                remedy="Leave it out, or make it smaller.",
            )
        if self._bytes > limits.max_bytes:
            raise too_many_bytes(f"over {limits.max_bytes}", limits.max_bytes, name)


def too_many_entries(count: str, max_entries: int) -> ServiceError:
    """The archive holds more entries than the limit."""
    return ArchiveTooLarge(
        f"the archive has {count} entries, the bound is {max_entries}",
        remedy="Put only the drive's files into it, or send several archives.",
    )


def too_many_bytes(size: str, max_bytes: int, name: str | bytes) -> ServiceError:
    """The archive unpacks to more bytes than the limit, from the named entry on."""
    return ArchiveTooLarge(
        f"the archive unpacks to {size} bytes with entry {shown(name)}, the bound is {max_bytes}",
        remedy="Send the drive in several archives.",
    )


def quota_too_small(size_bytes: int, max_stored_bytes: int, name: str) -> ServiceError:
    """The archive's files, up to the named one, have more bytes than their project may store."""
    return QuotaFull(
        f"the files of the archive up to entry {shown(name)} have {size_bytes} bytes, equal ones counted once; the "
        f"project may store {max_stored_bytes}",
        remedy="Send fewer or smaller images, or ask the operator for a larger quota ('mrasfm projects set').",
    )


def require_ratio(what: str, *, packed_bytes: int, unpacked_bytes: int, max_ratio: float) -> None:
    """Refuse what is made to fill the disk.

    Parameters
    ----------
    what
        Subject of the message.

    Raises
    ------
    ServiceError
        422 `archive-too-large`, if the compression ratio is over `max_ratio`.
    """
    if unpacked_bytes > SMALL_BYTES and unpacked_bytes > max_ratio * packed_bytes:
        raise ArchiveTooLarge(
            f"{what} unpacks to {unpacked_bytes} bytes from {packed_bytes}: the compression ratio is over "
            f"{max_ratio:g}, as no image's is",
            remedy="Make the archive of the drive's images, without compression if need be.",
        )
