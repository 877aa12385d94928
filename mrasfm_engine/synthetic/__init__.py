"""Rendered and simulated drives with ground truth."""
