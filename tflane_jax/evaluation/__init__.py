"""Evaluation: predictions and examples converted to the inputs of every protocol.

Confidences are the logistic function of logits, by scipy on the host, in the type of the logits (float32), as TopoNet's
and LaneSegNet's programs have them. Logits above about 17 all have the confidence 1 then, and from about 14 on, close
ones have the same. Those of map lines (`vector_maps`, `found_lanes`) are taken in float64, because every pair of query
and class competes for a rank there. Recorded results depend on the last bits: keep both types.
"""
