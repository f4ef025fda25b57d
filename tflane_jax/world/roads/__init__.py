"""Road networks: layouts, lanes, junctions, signs, and the maps derived from them."""
