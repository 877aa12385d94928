"""Measures of a scene's accuracy against the truth."""
