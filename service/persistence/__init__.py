"""The system of record: projects, drives, jobs and scenes in a SQL database, bytes in an artifact store.

The API writes what was asked, workers write what came of it. The broker only wakes workers up: what is not committed
here does not exist, and what is committed here survives the loss of everything else.
"""
