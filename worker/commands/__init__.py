"""Subcommands of `mrasfm` that the workers add."""
