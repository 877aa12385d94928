"""Mapping: units are registered one after the other, and the scene is refined."""
