"""Measurements of the method beside baseline methods, on drives of its own and on published data sets."""
