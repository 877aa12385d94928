"""Rotations, cameras, positions on the earth: pure numpy and small compiled functions."""
