"""Comparing configurations over seeds, and the statistics that say what a difference is worth."""
