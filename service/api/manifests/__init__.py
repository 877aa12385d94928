"""Drive manifests from outside: read within bounds of memory, and checked before a drive is committed."""
