"""Pictures of a finished scene by which a user can judge it."""
