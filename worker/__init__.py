"""The workers: they take jobs from the system of record and run the engine in child processes."""
