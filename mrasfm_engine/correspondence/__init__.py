"""Stage one: which images see the same, and where."""
