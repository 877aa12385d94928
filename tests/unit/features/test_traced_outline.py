"""The outline of the own car in judged pixels: which edges are enough, and which areas are sure."""

from __future__ import annotations

import numpy as np
import pytest

from mrasfm_engine.features.own_car import MIN_EVIDENCE_PX, MIN_EVIDENCE_SHARE
from mrasfm_engine.features.static_outline import Part, StaticEdges, trace_outline

HEIGHT, WIDTH, EDGE_ROW = 120, 160, 90
CHANGE_OF_WORLD = 0.2


def edges(*, lasting: float, change: float, gap: slice = slice(0, 0), across: float = 1.0) -> StaticEdges:
    """A bonnet below an edge from side to side: what stays of it, and how much its paint changes."""
    layers = {
        name: np.zeros((HEIGHT, WIDTH), np.float32)
        for name in ("lasting", "across", "strength", "step", "step_evidence")
    }
    layers["lasting"][EDGE_ROW - 2 : EDGE_ROW + 1] = lasting
    layers["across"][EDGE_ROW - 2 : EDGE_ROW + 1] = across
    layers["strength"][EDGE_ROW - 1] = 5.0
    changes = np.full((HEIGHT, WIDTH), CHANGE_OF_WORLD, np.float32)
    changes[EDGE_ROW:] = change
    layers["lasting"][:, gap], changes[:, gap] = 0.0, CHANGE_OF_WORLD
    return StaticEdges(
        **layers,
        edge=np.clip(layers["lasting"] - 1, 0, 1),
        always=np.ones((HEIGHT, WIDTH), np.float32),
        change=changes,
        fall=np.full((HEIGHT, WIDTH), 0.3, np.float32),
    )


def sure(parts: list[Part]) -> list[Part]:
    return [p for p in parts if p.evidence_px >= MIN_EVIDENCE_PX and p.evidence_share >= MIN_EVIDENCE_SHARE]


@pytest.mark.parametrize(
    ("lasting", "change", "found"),
    [
        (2.0, CHANGE_OF_WORLD, True),  # an edge for sure, whatever changes
        (0.8, CHANGE_OF_WORLD, False),  # less than the world keeps, on one surface
        (0.8, CHANGE_OF_WORLD / 4, True),  # enough where a surface begins that changes less
        (0.4, CHANGE_OF_WORLD / 4, False),  # not even half of what an edge keeps
    ],
)
def test_less_of_an_edge_is_enough_where_the_surface_below_changes_less(
    lasting: float, change: float, found: bool
) -> None:
    parts = sure(trace_outline(edges(lasting=lasting, change=change)))
    assert bool(parts) == found
    if found:
        np.testing.assert_allclose(parts[0].mask.sum(0), HEIGHT - EDGE_ROW, atol=1)


def test_edges_along_the_motion_are_no_evidence() -> None:
    assert not sure(trace_outline(edges(lasting=2.0, change=CHANGE_OF_WORLD / 4, across=0.0)))


def test_every_area_has_to_have_evidence_of_its_own() -> None:
    left, right = trace_outline(edges(lasting=2.0, change=CHANGE_OF_WORLD / 4, gap=slice(30, 80)))
    assert not (left.mask & right.mask).any()
    assert left.mask.any(0).sum() == pytest.approx(30, abs=2)
    assert left.evidence_px == pytest.approx(30, abs=2)
    assert right.evidence_px == pytest.approx(80, abs=2)


def test_a_narrow_gap_is_closed() -> None:
    (whole,) = trace_outline(edges(lasting=2.0, change=CHANGE_OF_WORLD / 4, gap=slice(70, 74)))
    assert whole.mask[-1].all()


def test_where_nothing_stays_there_is_no_area() -> None:
    assert trace_outline(edges(lasting=0.0, change=CHANGE_OF_WORLD)) == []
