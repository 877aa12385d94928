"""Writers of a scene's and a map's files; each file is read again before it is published."""
