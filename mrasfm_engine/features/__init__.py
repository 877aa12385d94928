"""Keypoints, descriptors and semantic masks of the images of a drive."""
