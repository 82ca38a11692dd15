"""A run's folder as a database: its files, records, journal, lock and settings."""
