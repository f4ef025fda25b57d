"""Evaluation: predictions and examples converted to the inputs of every protocol.

Confidences are the logistic function of logits, by scipy on the host, in the type of the logits (float32). Those of map
lines (`vector_maps`, `found_lanes`) are taken in float64: every pair of query and class competes for a rank, and in
float32 all logits above about 17 have the confidence 1. Recorded results depend on the last bits: keep both types.
"""
