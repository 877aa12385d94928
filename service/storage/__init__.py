"""Bytes: the artifact store, blobs, the data folder and the spool of uploads."""
