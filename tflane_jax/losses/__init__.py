"""Losses on matched pairs. Elementwise where possible; who calls them reduces."""
