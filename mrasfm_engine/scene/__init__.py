"""The data of all rooms: drives, scenes, and the estimated state."""
