"""Subcommands of `mrasfm`: arguments in, a call, words out."""
