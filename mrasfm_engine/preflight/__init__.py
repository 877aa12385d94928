"""Checks of a drive that take seconds, before hours of work."""
