"""Drives under other manifests, whose images stay where they are."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

Edit = Callable[[dict[str, Any]], None]


def edited_drive(drive: Path, copy: Path, edit: Edit) -> Path:
    """A copy of the drive whose manifest is edited. Its other files are links: nobody may write into them."""
    shutil.copytree(drive, copy, copy_function=os.link)
    manifest = json.loads((drive / "drive.json").read_text(encoding="utf-8"))
    edit(manifest)
    (copy / "drive.json").unlink()  # a link to the other drive's
    (copy / "drive.json").write_text(json.dumps(manifest), encoding="utf-8")
    return copy
