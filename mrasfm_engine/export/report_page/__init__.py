"""`report.html`: a result in one file for people, which asks for nothing and needs no script to be read."""

from __future__ import annotations

from mrasfm_engine.export.report_page._maps import map_page
from mrasfm_engine.export.report_page._scenes import scene_page
from mrasfm_engine.export.report_page._writing import write_page

__all__ = ["map_page", "scene_page", "write_page"]
