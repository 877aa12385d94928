"""What everything else speaks about: drives, scenes, and the state that is being estimated."""
