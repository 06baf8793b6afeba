"""Evaluations of tables: folder, records, cache of predictions, shards."""
