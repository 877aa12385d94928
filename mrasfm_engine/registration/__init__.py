"""Stage two: units get poses, one after the other, and the scene is refined."""
