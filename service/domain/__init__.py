"""The rules of projects, drives, jobs, scenes and maps, as transactions on the database.

The database is the system of record: the API writes requests and workers write results. The broker carries only
wake-ups. What is not committed in the database does not exist; what is committed survives the loss of everything else.
"""
