"""Tracks and their points."""
