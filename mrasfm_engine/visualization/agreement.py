"""Agreement of the views of different cameras on the ground that they share."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.spatial import cKDTree

from mrasfm_engine.geometry.parabola import vertex
from mrasfm_engine.types import Bytes, Floats, Floats32, Ints
from mrasfm_engine.visualization.mosaic import Grid, Mosaic
from mrasfm_engine.visualization.views import GIVEN, REFINED

FINE_CELL_M = 0.05  # with larger cells, displacements of a few centimetres are not seen
PLOT_SIDE_M = 9.6  # the roadside on both sides of the trajectory, and where it is searched
MAX_PLOTS = 40
BLOCK_M = 0.8  # side of the pieces of ground that are compared
ROADSIDE_M = 4.0  # farther from the trajectory there are kerbs
SEARCH_M = 0.4  # displacements up to this are found
MIN_COVER = 0.96  # of the cells of a piece and of where it is searched
MIN_CONTRAST = 3.0  # standard deviation of grey values: plain asphalt says nothing
MAX_BLOCKS = 600  # those of most contrast
SMOOTHING_M = 0.03  # against noise, and so that a sharper and a softer image compare
MIN_PEAK = 0.6  # correlation at which a displacement counts as found
MIN_BLOCKS = 12
BOOTSTRAPS = 400
SIGMAS = 2.0  # of a difference of correlations, below which it is none
MANY = 0.25  # of the pieces
HIGH = 0.9  # correlation, above which markings are in one place


@dataclass(frozen=True, kw_only=True)
class Agreement:
    """Agreement of two cameras' views of the same ground.

    Attributes
    ----------
    correlations
        (blocks,) normalised cross-correlation of the two views where they lie, -1 to 1.
    displaced_blocks
        Pieces whose displacement could be found.
    displacement_m
        Their median displacement between the two views.
    """

    correlations: Floats
    displaced_blocks: int
    displacement_m: float

    @property
    def blocks(self) -> int:
        """Number of pieces that were compared."""
        return len(self.correlations)

    @property
    def correlation(self) -> float:
        """Median of their correlations."""
        return float(np.median(self.correlations))


def plots_along(trajectory_m: Floats) -> list[Grid]:
    """Squares of ground in the finest cells, spread evenly over a way (n, 2) that the cells of one picture are too
    coarse for; at most `MAX_PLOTS`, and none where another one is."""
    travelled = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(trajectory_m, axis=0), axis=1))])
    even = np.linspace(0.0, travelled[-1], 2 * MAX_PLOTS + 1)[1::2]
    chosen: list[Floats] = []
    for place in trajectory_m[np.searchsorted(travelled, even)]:
        if all(np.abs(place - other).max() >= PLOT_SIDE_M for other in chosen):
            chosen.append(place)
    return [Grid.square(place, side_m=PLOT_SIDE_M) for place in chosen]


def measure_agreement(mosaics: Sequence[Mosaic], trajectory_m: Floats) -> tuple[Agreement, Agreement] | None:
    """Agreement of the best with the second best camera under the given and under the refined calibration.

    Both are measured on the same pieces within `ROADSIDE_M` of the trajectory (n, 2), chosen by contrast alone; None
    where there are too few. All mosaics, of different ground, have cells of one size, no larger than `FINE_CELL_M`.
    """
    if not mosaics:
        return None
    cell = mosaics[0].grid.cell_m
    if any(mosaic.grid.cell_m != cell for mosaic in mosaics) or cell > FINE_CELL_M:
        raise ValueError("the mosaics' cells differ, or are too coarse")
    size, margin = round(BLOCK_M / cell), round(SEARCH_M / cell)
    tree = cKDTree(trajectory_m)
    blocks: list[_Block] = []
    for mosaic in mosaics:
        blocks += _textured_blocks(mosaic, tree, size, margin)
        blocks = sorted(blocks, key=lambda block: -block.contrast)[:MAX_BLOCKS]
    if len(blocks) < MIN_BLOCKS:
        return None
    given, refined = (_compare(blocks, which, margin, cell) for which in (GIVEN, REFINED))
    return given, refined


@dataclass(frozen=True, kw_only=True)
class _Block:
    """Grey values of a piece of ground in the best view (s, s), and of where it is searched in the second best one
    (s + 2 margins, s + 2 margins), by calibration."""

    contrast: float  # the smaller of the two views' standard deviations
    template: Floats32  # (2, s, s)
    window: Floats32  # (2, s + 2 margins, s + 2 margins)


def _gray(mosaic: Mosaic) -> list[list[Bytes]]:
    """Grey pictures by calibration and layer."""
    sigma = SMOOTHING_M / mosaic.grid.cell_m
    return [
        [
            np.asarray(cv2.GaussianBlur(cv2.cvtColor(layer, cv2.COLOR_RGB2GRAY), None, sigma), dtype=np.uint8)
            for layer in layers
        ]
        for layers in mosaic.color
    ]


def _textured_blocks(mosaic: Mosaic, trajectory: cKDTree, size: int, margin: int) -> list[_Block]:
    """Pieces that both layers cover with their surroundings, of most contrast in both under the refined calibration."""
    seen = (mosaic.owner > 0).all(axis=0).astype(np.uint8)
    covered = cv2.integral(seen)
    rows = np.arange(margin, mosaic.grid.rows - size - margin, size)
    columns = np.arange(margin, mosaic.grid.columns - size - margin, size)
    if not len(rows) or not len(columns) or not seen.any():
        return []
    r, c = (a.ravel() for a in np.meshgrid(rows, columns, indexing="ij"))
    r0, r1, c0, c1 = r - margin, r + size + margin, c - margin, c + size + margin
    cover = covered[r1, c1] - covered[r0, c1] - covered[r1, c0] + covered[r0, c0]
    grid = mosaic.grid
    x, y = grid.left_m + (c + size / 2) * grid.cell_m, grid.top_m - (r + size / 2) * grid.cell_m
    from_trajectory_m, _ = trajectory.query(np.column_stack([x, y]))
    whole = (cover >= MIN_COVER * (size + 2 * margin) ** 2) & (from_trajectory_m < ROADSIDE_M)
    r, c = r[whole], c[whole]
    gray = _gray(mosaic)
    contrast = np.minimum(*(_contrast(g, r, c, size) for g in gray[REFINED]))
    best = [k for k in np.argsort(-contrast, kind="stable")[:MAX_BLOCKS] if contrast[k] >= MIN_CONTRAST]
    return [
        _Block(
            contrast=float(contrast[k]),
            template=np.stack([g[0][r[k] : r[k] + size, c[k] : c[k] + size] for g in gray], dtype=np.float32),
            window=np.stack(
                [g[1][r[k] - margin : r[k] + size + margin, c[k] - margin : c[k] + size + margin] for g in gray],
                dtype=np.float32,
            ),
        )
        for k in best
    ]


def _contrast(gray: Bytes, r: Ints, c: Ints, size: int) -> Floats32:
    """Standard deviation (n,) of the pieces of so many pixels a side that begin at rows and columns (n,)."""
    pieces = np.lib.stride_tricks.sliding_window_view(gray, (size, size))[r, c]
    result: Floats32 = pieces.astype(np.float32).std(axis=(1, 2))
    return result


def _compare(blocks: Sequence[_Block], which: int, margin: int, cell_m: float) -> Agreement:
    correlations, displacements = [], []
    for block in blocks:
        score = np.nan_to_num(cv2.matchTemplate(block.window[which], block.template[which], cv2.TM_CCOEFF_NORMED))
        correlations.append(float(score[margin, margin]))
        i, j = np.unravel_index(int(score.argmax()), score.shape)
        if score[i, j] >= MIN_PEAK and 0 < i < 2 * margin and 0 < j < 2 * margin:
            di = vertex(score[i - 1, j], score[i, j], score[i + 1, j])
            dj = vertex(score[i, j - 1], score[i, j], score[i, j + 1])
            displacements.append(cell_m * float(np.hypot(i + di - margin, j + dj - margin)))
    return Agreement(
        correlations=np.array(correlations),
        displaced_blocks=len(displacements),
        displacement_m=float(np.median(displacements)) if displacements else float("nan"),
    )


def why_not_better(given: Agreement, refined: Agreement, *, changed: bool) -> str | None:
    """Say why the views do not agree better with the refined calibration; None where they do.

    Parameters
    ----------
    changed
        Whether the calibrations differ at all.
    """
    if not changed:
        return "the calibration was held"
    gain = refined.correlation - given.correlation
    sigma = _sigma_of_gain(given.correlations, refined.correlations)
    if gain > SIGMAS * sigma:
        return None
    if abs(gain) <= SIGMAS * sigma:
        return f"the difference of {gain:+.3f} is within {SIGMAS:g} of its standard errors of {sigma:.3f}"
    found = f"the views agree less by {-gain:.3f}, with a standard error of {sigma:.3f}"
    without = float((np.maximum(given.correlations, refined.correlations) < MIN_PEAK).mean())
    if without > MANY:
        return (
            f"{found}; {without:.0%} of the pieces agree with neither calibration: they show what moves or stands there"
        )
    if given.correlation > HIGH and refined.correlation > HIGH:
        return (
            f"{found}; they agree well with both calibrations, and the refined one fits the whole scene, the height of "
            "the ground not included"
        )
    return f"{found}; the refined calibration fits the points of the scene better than the ground as it was estimated"


def _sigma_of_gain(given: Floats, refined: Floats) -> float:
    """Standard error of the difference of two medians over the same pieces, by bootstrap."""
    drawn = np.random.default_rng(0).integers(0, len(given), (BOOTSTRAPS, len(given)))
    return float(np.std(np.median(refined[drawn], axis=1) - np.median(given[drawn], axis=1)))
