"""Predictions and examples to every protocol."""
