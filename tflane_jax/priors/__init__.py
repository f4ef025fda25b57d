"""Priors: raw observations -> arrays and masks of fixed size. No parameters.

Selection (`traffic_flow`, `markers`, `sd_map`) runs in numpy or under jit; rasters and memory are JAX.
"""
