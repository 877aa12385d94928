"""Bytes from outside: received, checked and stored whole or not at all."""
