"""Readers and writers."""

import os

from schemas.drive import MAX_IMAGE_SIDE_PX

# OpenCV reads this when it is first imported; headers are checked before decoding in any case.
os.environ.setdefault("OPENCV_IO_MAX_IMAGE_PIXELS", str(MAX_IMAGE_SIDE_PX**2))
