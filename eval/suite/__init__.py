"""Evaluations of tables: folder, records, tasks."""
