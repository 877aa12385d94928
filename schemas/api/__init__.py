"""What crosses the HTTP API, as pydantic models with examples."""
