"""Subcommands of `mrasfm` that the service adds."""
