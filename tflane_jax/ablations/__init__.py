"""Comparisons of configurations over seeds and test sets, with paired statistics."""
