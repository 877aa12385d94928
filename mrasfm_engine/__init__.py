"""MRASfM: multi-camera reconstruction of driving scenes by structure from motion."""

__version__ = "0.1.0"
