"""Importers: folders as they are distributed become drive bundles."""
