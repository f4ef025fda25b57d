"""Evaluation: predictions and examples converted to the inputs of every protocol."""
