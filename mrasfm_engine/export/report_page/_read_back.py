"""Reader of a page, for the check before it is put in place: what it would load, and the numbers that it shows."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

from mrasfm_engine.export.report_page._calibration import MOST_SCENES

MOST_BYTES = 2_000_000
_LOADING = ("src", "href", "srcset", "data", "action", "poster")


class _Page(HTMLParser):
    def __init__(self) -> None:
        super().__init__()
        self.loads: list[str] = []
        self.values: dict[tuple[str, str, str, str], str] = {}  # of corrections: scene, kind, camera, axis
        self._scene, self._kind, self._camera = "", "", ""

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = {name: value or "" for name, value in attrs}
        self.loads += [given[name] for name in _LOADING if name in given]
        if tag == "table":
            self._kind, self._scene = given.get("data-corrections", ""), given.get("data-scene", "")
        if tag == "tr":
            self._camera = given.get("data-camera", "")
        if self._kind and "data-axis" in given:
            self.values[self._scene, self._kind, self._camera, given["data-axis"]] = given["data-value"]


def faults_of(path: Path, calibrations: Mapping[str, Mapping[str, Any]] | None = None) -> Iterator[str]:
    """Faults of a page, in words.

    Parameters
    ----------
    calibrations
        Documents whose corrections the page shows, by the scene's name in a map; of a scene's page by "".
    """
    size = path.stat().st_size
    if size > MOST_BYTES:
        yield f"it has {size} bytes, over {MOST_BYTES}"
    page = _Page()
    page.feed(path.read_text(encoding="utf-8"))
    page.close()
    if any(not target.startswith("data:") for target in page.loads):
        yield "it would load something"
    shown = {scene for scene, _, _, _ in page.values}
    for scene, calibration in (calibrations or {}).items():
        if scene not in shown and len(shown) >= MOST_SCENES:
            continue
        for name, camera in calibration["cameras"].items():
            for kind, field in (("rotation", "rotation_vector_deg"), ("translation", "translation_m")):
                for axis, value in zip("xyz", camera["difference"][field], strict=True):
                    if float(page.values.get((scene, kind, name, axis), "nan")) != value:
                        yield f"the {kind} of {name} about {axis} is another{f' in {scene}' if scene else ''}"
