"""Drives whose truth is known: a renderer of whole drives, and a simulator of observations without images.

`render_drives(SynthOptions(...), folder)` of `drive_writer` renders; `simulate_observations(...)` simulates. The
renderer is not imported here, because its compiled kernels take a second to load.
"""

from mrasfm_engine.synthetic.options import SpeedProfile, SynthOptions, World, small_options
from mrasfm_engine.synthetic.simulate import SimulatedObservations, simulate_observations

__all__ = [
    "SimulatedObservations",
    "SpeedProfile",
    "SynthOptions",
    "World",
    "simulate_observations",
    "small_options",
]
