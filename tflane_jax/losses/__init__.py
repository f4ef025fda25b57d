"""Losses on matched pairs of queries and targets: one file per host, common terms, auxiliary losses.

Losses take a batch, because their normalisers count matched queries of the whole batch; models take one example.
"""
