"""Content of a bag but for its images: what its topics say of cameras, the vehicle and a receiver."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from mrasfm_engine.errors import InputError
from mrasfm_engine.importers.bag_cameras import camera_name, chosen_topics, same_calibration
from mrasfm_engine.importers.bag_images import holds_depth, largest_value, size_and_suffix
from mrasfm_engine.importers.bag_reader import Bag, Entry
from mrasfm_engine.importers.bag_transforms import TransformTree
from mrasfm_engine.io.images import unused_bits
from schemas.drive import MAX_GNSS_SAMPLES

IMAGE, COMPRESSED_IMAGE = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
CAMERA_INFO, FIX = "sensor_msgs/msg/CameraInfo", "sensor_msgs/msg/NavSatFix"
TRANSFORMS = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")
MAX_IMAGES = 2_000_000


@dataclass(kw_only=True)
class ImageTopic:
    """Images of one topic: those that can be used and those that cannot."""

    frame: str = ""
    size: tuple[int, int] = (0, 0)
    suffixes: dict[int, str] = field(default_factory=dict)  # of the images' files, by their stamps in nanoseconds
    repeated: int = 0  # images with a stamp that another one has
    unstamped: int = 0  # images with no time but that of their recording
    defects: list[InputError] = field(default_factory=list)  # of the other images
    holds_depth: bool = False
    largest: int = 0  # value of images of 16 bits

    @property
    def shift(self) -> int:
        """Bits by which values are raised: of a sensor of 12 bits in 16, a picture would be all but black."""
        return unused_bits(self.largest)


@dataclass(kw_only=True)
class BagContent:
    """Everything of a bag but its images."""

    images: dict[str, ImageTopic]
    infos: dict[str, Any]  # the first CameraInfo of each topic
    transforms: TransformTree
    fix_topic: str
    fixes: list[tuple[int, Any]]  # stamp in nanoseconds, NavSatFix


def wanted_topics(types: dict[str, str], topics: Sequence[str], path: Path) -> tuple[list[str], list[str], list[str]]:
    """Topics of images and of receivers, and notes of what is left out."""
    known_images = [t for t, kind in types.items() if kind in (IMAGE, COMPRESSED_IMAGE)]
    known_fixes = [t for t, kind in types.items() if kind == FIX]
    if unknown := [topic for topic in topics if topic not in known_images + known_fixes]:
        raise InputError(
            f"bag {path} has no images or positions in {', '.join(unknown)}",
            remedy=f"Choose among {', '.join(known_images + known_fixes) or 'none: the bag has neither'}.",
            code="unknown-topic",
        )
    pictures = [t for t in known_images if not t.endswith(("compressedDepth", "theora"))]
    images = [t for t in topics if t in known_images] or chosen_topics(pictures)
    if not images:
        others = ", ".join(f"{topic} ({kind})" for topic, kind in list(types.items())[:20]) or "nothing"
        raise InputError(
            f"bag {path} has no topic of images ({IMAGE} or {COMPRESSED_IMAGE}), but {others}",
            remedy="Record the cameras' images as one of these types.",
            code="no-images",
        )
    repeated = [name for name, count in Counter(map(camera_name, images)).items() if count > 1]
    if repeated:
        own = ", ".join(topic for topic in images if camera_name(topic) == repeated[0])
        raise InputError(
            f"several topics are of camera {repeated[0]}: {own}",
            remedy="Name one topic of each camera with --topics.",
            code="several-topics",
        )
    fixes = [t for t in topics if t in known_fixes] if topics else known_fixes
    if len(fixes) > 1:
        raise InputError(
            f"bag {path} has positions of several receivers: {', '.join(fixes)}",
            remedy="Name one of them with --topics, beside the topics of images.",
            code="several-topics",
        )
    left = sorted({*pictures} - {*images})
    return images, fixes, [f"Left out: images of {', '.join(left)}."] if left else []


def read_content(
    bag: Bag, types: dict[str, str], images: list[str], fixes: list[str], *, keeps_motion: bool
) -> BagContent:
    """Read the wanted topics, and all of CameraInfo and transforms, once.

    Parameters
    ----------
    types
        Of all topics.
    images, fixes
        Wanted topics.
    keeps_motion
        Whether the poses of moving frames are wanted.

    Raises
    ------
    InputError
        If the bag is damaged or too long, a camera's calibration changes, or its transforms contradict one another.
    """
    content = BagContent(
        images={topic: ImageTopic() for topic in images},
        infos={},
        transforms=TransformTree(keeps_motion=keeps_motion),
        fix_topic=", ".join(fixes),
        fixes=[],
    )
    infos = {topic for topic, kind in types.items() if kind == CAMERA_INFO}
    transforms = {topic for topic, kind in types.items() if kind in TRANSFORMS}
    for entry in bag.entries({*images, *fixes, *infos, *transforms}):
        if entry.topic in transforms:
            content.transforms.add(entry.message, topic=entry.topic)
        elif entry.topic in infos:
            _add_info(content, entry)
        elif entry.topic in content.images:
            _add_image(content.images[entry.topic], entry)
        else:
            content.fixes.append((stamp_ns(entry), entry.message))
            if len(content.fixes) > MAX_GNSS_SAMPLES:
                raise InputError(f"{entry.topic} has over {MAX_GNSS_SAMPLES} positions", remedy="Cut the bag.")
    if sum(len(topic.suffixes) for topic in content.images.values()) > MAX_IMAGES:
        raise InputError(f"the bag has over {MAX_IMAGES} images", remedy="Cut it into several.", code="bad-size")
    return content


def stamp_ns(entry: Entry) -> int:
    """The time that the message's sender has set; where there is none, the time of recording."""
    return _set_ns(entry) or entry.received_ns


def _set_ns(entry: Entry) -> int:
    stamp = entry.message.header.stamp
    return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)


def us_from_ns(time_ns: int) -> int:
    """Microseconds, rounded."""
    return (time_ns + 500) // 1000


def _add_info(content: BagContent, entry: Entry) -> None:
    first = content.infos.setdefault(entry.topic, entry.message)
    if first is not entry.message and not same_calibration(first, entry.message):
        raise InputError(
            f"{entry.topic}: the calibration changes within the bag",
            remedy="Cut the bag where it changes, or give one calibration with --calibration.",
            code="bad-calibration",
        )


def _add_image(images: ImageTopic, entry: Entry) -> None:
    images.holds_depth |= holds_depth(entry.message)
    try:
        size, suffix = size_and_suffix(entry.message, topic=entry.topic)
        if images.suffixes and size != images.size:
            raise InputError(
                f"{entry.topic}: images have {images.size[0]}x{images.size[1]} and {size[0]}x{size[1]} pixels",
                remedy="Record one size.",
                code="bad-image",
            )
        images.largest = max(images.largest, largest_value(entry.message, topic=entry.topic))
    except InputError as defect:
        images.defects.append(defect)
        return
    images.size, images.frame = size, entry.message.header.frame_id.removeprefix("/")
    stamp = stamp_ns(entry)
    images.repeated += stamp in images.suffixes
    images.unstamped += _set_ns(entry) == 0
    images.suffixes.setdefault(stamp, suffix)


def without_unusable(content: BagContent, *, is_asked: bool) -> list[str]:
    """Take topics out of which no image can be used; notes of all that is left out.

    Raises
    ------
    InputError
        If such a topic was asked for, or holds pictures, not distances.
    """
    notes = []
    for topic, images in [*content.images.items()]:
        if not images.suffixes and images.defects:
            if is_asked or not images.holds_depth:
                raise images.defects[0]
            del content.images[topic]
            notes.append(f"Left out: {topic}, which holds distances.")
        elif images.defects:
            first = images.defects[0].what
            notes.append(f"Left out: {len(images.defects)} images of {topic}. The first: {first}"[:1500])
        if images.shift:
            bits = 16 - images.shift
            notes.append(f"Images of {topic} use {bits} of 16 bits: all values are taken times {2**images.shift}.")
        if images.unstamped:
            notes.append(
                f"Times: {images.unstamped} images of {topic} have no stamp. The times of their recording are taken, "
                "which are later."
            )
        if images.repeated:
            notes.append(f"Left out: {images.repeated} images of {topic} with a stamp that an earlier one has.")
    if not content.images:
        raise InputError(
            "the bag has images of distances alone", remedy="Record the cameras' images.", code="no-images"
        )
    return notes
