"""The SQL database: connections, tables and migrations."""
