"""Fiducial markers: their patterns, finding them in images, and the lane graphs that their ids name.

Paper: "Confidence-Gated Topology Reasoning with Fiducial Marker Priors" (shared/papers/marker_fusion.txt), sections III
and IV-A.

The **frame of a marker**, the same everywhere: origin at the middle of its black square, x to the right and y up in its
plane as one sees it who looks at it, z out of it towards whoever looks; metres. Its **size** is the side of the black
square, as OpenCV counts it; the white margin around it is not part of it.
"""
