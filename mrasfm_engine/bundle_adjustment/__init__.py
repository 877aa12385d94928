"""Camera set bundle adjustment."""
