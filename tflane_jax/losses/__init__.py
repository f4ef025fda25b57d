"""Losses on matched pairs: a file for each host, terms that hosts share, auxiliary losses."""
