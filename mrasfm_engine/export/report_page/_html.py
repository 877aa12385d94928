"""Parts of a page: escaped text, numbers with their exact value, tables, pictures, charts."""

from __future__ import annotations

import base64
import hashlib
import math
from collections.abc import Iterable, Mapping, Sequence
from html import escape
from importlib.resources import files
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from mrasfm_engine.types import Floats

_STATIC = files("mrasfm_engine.visualization") / "static"
# Longest side, and what each of two pictures may have so that a page stays below 2 MB.
PREVIEW_PX, PREVIEW_BYTES = 1600, 550_000
SMALLEST_PX = 240
SERIES = ("#0b8a8a", "#c25e00", "#7a4fc4")


def page(title: str, sections: Iterable[str]) -> str:
    """The whole document. Its policy lets nothing be loaded, and no script run but the one that is part of it."""
    style, script = (_STATIC.joinpath(f"report.{kind}").read_text(encoding="utf-8") for kind in ("css", "js"))
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    policy = (
        f"default-src 'none'; img-src data:; style-src 'unsafe-inline'; script-src 'sha256-{digest}'; base-uri 'none'"
    )
    return (
        '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        f'<meta http-equiv="Content-Security-Policy" content="{policy}">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        '<meta name="color-scheme" content="light dark">\n<link rel="icon" href="data:,">\n'
        f"<title>{escape(title)}</title>\n"
        f"<style>{style}</style>\n</head>\n<body>\n<main>\n{''.join(sections)}</main>\n<script>{script}</script>\n"
        "</body>\n</html>\n"
    )


def text(value: object) -> str:
    """Escaped text."""
    return escape(str(value))


def exact(value: float) -> str:
    """All digits of a number, as JSON has them."""
    return repr(value.item() if isinstance(value, np.generic) else value)


def shown(value: float, digits: int) -> str:
    """A number with so many significant digits."""
    if not math.isfinite(value):
        return "not known"
    if value == 0:
        return "0"
    return f"{value:.{decimals_of(value, digits)}f}"


def decimals_of(value: float, digits: int) -> int:
    """Decimals that show so many significant digits of a number."""
    return min(9, max(0, digits - 1 - math.floor(math.log10(abs(value)))))


def number(value: float, unit: str = "", digits: int = 3) -> str:
    """A number with its unit, and its exact value in `data-value`."""
    if isinstance(value, int | np.integer):
        return f'<span class="n" data-value="{exact(value)}">{value:,}</span>'.replace(",", " ") + _unit(unit)
    return f'<span class="n" data-value="{exact(value)}">{shown(value, digits)}</span>{_unit(unit)}'


def number_with_sigma(value: float, sigma: float, *, digits: int = 2, attributes: str = "") -> str:
    """A number and its sigma with the decimals that show so many significant digits of the sigma."""
    decimals = decimals_of(sigma, digits)
    return (
        f'<span class="n" {attributes} data-value="{exact(value)}" data-sigma="{exact(sigma)}">'
        f"{value:.{decimals}f} <small>± {sigma:.{decimals}f}</small></span>"
    )


def _unit(unit: str) -> str:
    return f" {unit}" if unit else ""


def section(title: str, *parts: str) -> str:
    """A part with its heading; none where it has no content."""
    content = "".join(parts)
    return f"<section>\n<h2>{text(title)}</h2>\n{content}</section>\n" if content else ""


def table(head: Sequence[str], rows: Iterable[tuple[Sequence[str], str]], *, attributes: str = "") -> str:
    """A table; a row is its cells, which are HTML, and its own attributes."""
    heads = "".join(f'<th scope="col">{text(name)}</th>' for name in head)
    body = "".join(
        f'<tr {own}><th scope="row">{cells[0]}</th>{"".join(f"<td>{cell}</td>" for cell in cells[1:])}</tr>\n'
        for cells, own in rows
    )
    whole = f"<thead><tr>{heads}</tr></thead><tbody>\n{body}</tbody>"
    return f'<div class="scroll"><table {attributes}>{whole}</table></div>\n'


def facts(pairs: Mapping[str, str]) -> str:
    """Figures side by side; the values are HTML."""
    return (
        '<dl class="facts">'
        + "".join(f"<div><dt>{text(k)}</dt><dd>{v}</dd></div>" for k, v in pairs.items())
        + "</dl>\n"
    )


def items(lines: Iterable[str], kind: str = "") -> str:
    """A list of HTML lines."""
    return f'<ul class="{kind}">' + "".join(f"<li>{line}</li>\n" for line in lines) + "</ul>\n"


def preview(path: Path, most_bytes: int = PREVIEW_BYTES) -> str | None:
    """A picture, made smaller until it has at most so many bytes, as a data URI; None where there is none."""
    picture = cv2.imread(str(path), cv2.IMREAD_COLOR) if path.is_file() else None
    if picture is None:
        return None
    side = float(min(PREVIEW_PX, max(picture.shape[:2])))
    while True:
        factor = min(1.0, side / max(picture.shape[:2]))
        small = cv2.resize(picture, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA) if factor < 1 else picture
        data = bytes(cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, 82])[1])
        if len(data) <= most_bytes or side <= SMALLEST_PX:
            break
        # Bytes go with the area; somewhat less, so that the next try fits.
        side = max(SMALLEST_PX, min(0.95 * side * math.sqrt(most_bytes / len(data)), 0.8 * side))
    return f"data:image/jpeg;base64,{base64.b64encode(data).decode()}"


def pair(folder: Path, before: str, after: str, caption: str, most_bytes: int = PREVIEW_BYTES) -> str:
    """Two pictures of one place, of so many bytes each; without a script one below the other."""
    pictures = [preview(folder / name, most_bytes) for name in (before, after)]
    if None in pictures:
        return ""
    images = "".join(
        f'<div class="{which}"><span class="tag">{which}</span>'
        f'<img src="{picture}" alt="{text(caption)}: {which}"></div>'
        for which, picture in zip(("before", "after"), pictures, strict=True)
    )
    return f'<figure class="pair"><div class="stack">{images}</div><figcaption>{text(caption)}</figcaption></figure>\n'


def bars(rows: Iterable[tuple[str, float, str]]) -> str:
    """Lengths beside names: name, value, the value in words (HTML)."""
    found = list(rows)
    most = max((value for _, value, _ in found), default=0.0) or 1.0
    lines = (
        ([text(name), f'<span class="bar" style="width:{max(100 * value / most, 0.5):.1f}%"></span>', words], "")
        for name, value, words in found
    )
    return table(["Stage", "Share", "Time"], lines, attributes='class="bars"')


def chart(title: str, x: Floats, series: Mapping[str, Floats], *, x_unit: str, y_unit: str) -> str:
    """Lines over a common axis; missing values leave a gap."""
    width, height, left, low_edge = 760.0, 190.0, 70.0, 26.0
    values = np.concatenate([np.zeros(1), *[line[np.isfinite(line)] for line in series.values()]])
    y0, y1 = float(values.min()), float(values.max())
    margin = 0.06 * ((y1 - y0) or 1.0)
    span = float(x.max() - x.min()) or 1.0
    px = left + (x - x.min()) / span * (width - left - 10)
    parts = []
    for level in sorted({y0, 0.0, y1}):
        py = _height_px(level, y0 - margin, y1 + margin, height, low_edge)
        parts.append(f'<line class="axis" x1="{left}" x2="{width}" y1="{py:.1f}" y2="{py:.1f}"/>')
        parts.append(f'<text x="{left - 6}" y="{py + 4:.1f}" text-anchor="end">{shown(level, 2)} {y_unit}</text>')
    for color, line in zip(SERIES, series.values(), strict=False):
        py = _height_px(line, y0 - margin, y1 + margin, height, low_edge)
        parts += [
            f'<circle cx="{a:.1f}" cy="{b:.1f}" r="2.2" fill="{color}" data-value="{exact(v)}"/>'
            for a, b, v in zip(px, py, line, strict=True)
            if math.isfinite(v)
        ]
    parts.append(f'<text x="{left}" y="{height - 6}">{shown(float(x.min()), 3)} {x_unit}</text>')
    parts.append(f'<text x="{width}" y="{height - 6}" text-anchor="end">{shown(float(x.max()), 3)} {x_unit}</text>')
    legend = "".join(
        f'<li><span class="swatch" style="background:{c}"></span>{text(n)}</li>'
        for c, n in zip(SERIES, series, strict=False)
    )
    return (
        f'<figure class="chart"><figcaption>{text(title)}</figcaption>'
        f'<svg viewBox="0 0 {width} {height}" role="img" aria-label="{text(title)}">{"".join(parts)}</svg>'
        f'<ul class="legend">{legend}</ul></figure>\n'
    )


def _height_px(value: Any, low: float, high: float, height: float, edge: float) -> Any:
    return 8 + (1 - (value - low) / (high - low)) * (height - edge - 8)


def heat_map(grid: Floats, *, width: int, height: int, unit: str, largest: float) -> str:
    """Mean of something over the cells of an image, darker where it is larger; cells without a value stay empty."""
    rows, columns = grid.shape
    w, h = width / columns, height / rows
    cells = [
        f'<rect x="{c * w:.1f}" y="{r * h:.1f}" width="{w:.1f}" height="{h:.1f}" fill="#0b8a8a" '
        f'fill-opacity="{min(grid[r, c] / largest, 1.0):.3f}" data-value="{exact(grid[r, c])}">'
        f"<title>{shown(grid[r, c], 3)} {unit}</title></rect>"
        for r in range(rows)
        for c in range(columns)
        if math.isfinite(grid[r, c])
    ]
    return f'<svg class="heat" viewBox="0 0 {width} {height}" role="img">{"".join(cells)}</svg>'
