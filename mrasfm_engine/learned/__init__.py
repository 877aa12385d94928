"""Trained models: which are known, where they lie, and how they are run. Nothing here knows what a keypoint is for."""
