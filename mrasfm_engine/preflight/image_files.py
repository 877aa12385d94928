"""Checks a drive's image and mask files from their headers, and the ids of masks from their pixels."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from mrasfm_engine.errors import InputError
from mrasfm_engine.io.image_header import ImageHeader, ImageKind, read_header
from mrasfm_engine.io.images import check_image_header, check_mask_header, read_mask
from mrasfm_engine.io.repeated_images import comparison_of_contents, runs_of_same_images
from mrasfm_engine.scene.drive import Drive, DriveImage
from mrasfm_engine.types import CountProgress
from schemas.findings import Finding, Severity, error, listed, warning

MASK_THREADS = 4
IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg")

# Per code: severity, what is wrong with "N images" (%s is the list of files), remedy.
_GROUPED = {
    "alpha-channel": ("have an alpha channel, which is ignored", "Nothing needs to be done."),
    "16-bit-image": (
        "have 16 bits a channel and are read with the upper 8 of them",
        "Nothing needs to be done where their values reach up to 65535.",
    ),
    "palette-image": ("have a palette: their colours are quantised", "Give the camera's own images if you can."),
}


def check_images(
    drive: Drive, progress: CountProgress | None = None, *, content_sha256: Mapping[str, str] | None = None
) -> list[Finding]:
    """Findings about all files that the manifest lists, and about images that it does not.

    Parameters
    ----------
    content_sha256
        SHA-256 of the drive's files by name, where it is known.
    progress
        Called with how many of how many images are checked.
    """
    findings: list[Finding] = []
    paths, sound = _PathCheck(drive.root), list[DriveImage]()
    oddities: dict[str, list[str]] = {code: [] for code in _GROUPED}
    # One mask may serve many images, as that of the own car's body.
    masks = list({(i.mask, i.camera): i for i in drive.images if i.mask is not None}.values())
    total = len(drive.images) + len(masks)
    # Headers are read one by one: on a disk of the machine itself, threads would wait for the interpreter's lock three
    # times as long as it takes.
    for done, image in enumerate(drive.images, start=1):
        found_here, codes = _check_image(drive, image, paths)
        findings += found_here
        for code in codes:
            oddities[code].append(image.file)
        if not found_here:
            sound.append(image)
        if progress is not None:
            progress(done, total)
    with ThreadPoolExecutor(MASK_THREADS) as pool:
        for done, found in enumerate(pool.map(lambda i: _check_mask(drive, i, paths), masks), start=1):
            findings += found
            if progress is not None:
                progress(len(drive.images) + done, total)
    for code, (state, remedy) in _GROUPED.items():
        if oddities[code]:
            files = oddities[code]
            findings.append(warning(code, f"{len(files)} images {state}: {listed(files)}", remedy))
    return [*_gather(findings), *_repeated(drive, sound, content_sha256), *_unlisted(drive)]


class _PathCheck:
    """Refuses files that a symbolic link puts outside the drive; folders are resolved once."""

    def __init__(self, root: Path) -> None:
        self._root = root.resolve()
        self._inside: dict[Path, bool] = {}

    def check(self, path: Path, name: str) -> None:
        folder = path.parent
        if folder not in self._inside:
            self._inside[folder] = self._is_inside(folder)
        if not self._inside[folder] or (path.is_symlink() and not self._is_inside(path)):
            raise InputError(
                f"file {name} is a link to a place outside the drive",
                remedy="Put the file itself into the drive's folder.",
                code="path-escapes",
            )

    def _is_inside(self, path: Path) -> bool:
        try:
            return path.resolve().is_relative_to(self._root)
        except (OSError, RuntimeError):  # links in a circle
            return False


def _repeated(
    drive: Drive, images: Sequence[DriveImage], content_sha256: Mapping[str, str] | None
) -> Iterator[Finding]:
    """One finding of every camera with images that are those before them."""
    runs = runs_of_same_images(images, comparison_of_contents(drive, content_sha256))
    for camera, given in enumerate(drive.cameras):
        copies = [run[1:] for run in runs if run[0].camera == camera]
        if not copies:
            continue
        count = sum(image.camera == camera for image in drive.images)
        files = [image.file for run in copies for image in run]
        yield warning(
            "repeated-images",
            f"{len(files)} of {count} images of camera {given.name} are copies of the one before them, "
            f"up to {max(map(len, copies))} in a row: {listed(files)}",
            "Nothing needs to be done where a log has images twice. A camera, or what records it, that gets no new "
            "image repeats its last one: copies are left out, and what has no other images has no pose.",
        )


def _check_image(drive: Drive, image: DriveImage, paths: _PathCheck) -> tuple[list[Finding], list[str]]:
    """Findings, and codes of oddities that are reported once for all images."""
    path, camera = drive.path_of(image.file), drive.cameras[image.camera]
    try:
        paths.check(path, image.file)
        header = read_header(path)
        check_image_header(header, path)
    except InputError as problem:
        return [_finding(problem, path, image.file)], []
    findings = []
    if (header.width, header.height) != (camera.width, camera.height):
        findings.append(
            error(
                "image-size",
                f"image {image.file} has {header.width}x{header.height} pixels, the calibration of camera "
                f"{camera.name} is for {camera.width}x{camera.height}",
                "Give the images that the calibration was made for, or scale its width, height and params to them.",
            )
        )
    if header.orientation != 1:
        findings.append(
            error(
                "exif-orientation",
                f"image {image.file} is stored turned (EXIF orientation {header.orientation}), and images are read as "
                "they are stored",
                "Save it upright without the EXIF orientation, or remove the tag if the calibration is for the stored "
                "pixels.",
            )
        )
    return findings, _oddities(header)


def _oddities(header: ImageHeader) -> list[str]:
    codes = []
    if header.kind in (ImageKind.RGBA, ImageKind.GRAY_ALPHA):
        codes.append("alpha-channel")
    if header.bits == 16:
        codes.append("16-bit-image")
    if header.kind is ImageKind.PALETTE:
        codes.append("palette-image")
    return codes


def _check_mask(drive: Drive, image: DriveImage, paths: _PathCheck) -> list[Finding]:
    assert image.mask is not None
    path, camera = drive.path_of(image.mask), drive.cameras[image.camera]
    try:
        paths.check(path, image.mask)
        header = read_header(path)
        check_mask_header(header, path)
        check_image_header(header, path)
        if (header.width, header.height) != (camera.width, camera.height):
            raise InputError(
                f"mask {image.mask} has {header.width}x{header.height} pixels, its image has "
                f"{camera.width}x{camera.height}",
                remedy="Give masks of their images' size, without interpolating between ids.",
                code="mask-size",
            )
        read_mask(path, drive.manifest.label_map)
    except InputError as problem:
        return [_finding(problem, path, image.mask)]
    return []


def _finding(problem: InputError, path: Path, name: str) -> Finding:
    # By its name in the drive: where the drive lies on this machine is of no interest to who sent it.
    return error(problem.code, problem.what.replace(str(path), name), problem.remedy)


def _gather(findings: list[Finding], shown: int = 5) -> list[Finding]:
    """The first few findings of each code, and one more that counts the rest: a drive has thousands of images."""
    by_code: dict[str, list[Finding]] = {}
    for finding in findings:
        by_code.setdefault(finding.code, []).append(finding)
    result = []
    for code, group in by_code.items():
        result += group[:shown]
        if len(group) > shown:
            last, rest = group[-1], len(group) - shown
            result.append(
                Finding(
                    severity=Severity(last.severity),
                    code=code,
                    what=f"the same holds for {rest} more file{'' if rest == 1 else 's'}",
                    remedy=last.remedy,
                    count=rest,
                )
            )
    return result


def _unlisted(drive: Drive) -> Iterator[Finding]:
    known = {image.file for image in drive.images} | {image.mask for image in drive.images}
    extra = []
    for folder in sorted({Path(image.file).parent for image in drive.images}):
        try:
            names = sorted(entry.name for entry in os.scandir(drive.root / folder))
        except OSError:
            continue  # its images are reported as missing
        files = [(folder / name).as_posix() for name in names if name.lower().endswith(IMAGE_SUFFIXES)]
        extra += [file for file in files if file not in known]
    if extra:
        yield warning(
            "unlisted-images",
            f"{len(extra)} images in the drive's folders are not in drive.json and are ignored: {listed(extra)}",
            "List them in drive.json if they belong to the drive.",
        )
