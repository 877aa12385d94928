"""Requests and answers of the HTTP API, as pydantic models with examples."""
