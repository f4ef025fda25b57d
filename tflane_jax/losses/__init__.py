"""Losses on matched pairs of queries and targets: one file per host, common terms, auxiliary losses."""
