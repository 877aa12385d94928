"""Matching: image pairs are selected, matched, and verified geometrically."""
