"""API, broker, workers and reconciler as one program on one machine."""
