"""Measurements of the method beside its peers, on drives of its own and on published data sets."""
