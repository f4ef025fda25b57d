"""Fiducial markers: detection in images, simulated detection, and the store of lane graphs by marker id.

Source ("the marker paper"): Zirui Wu and Xianbiao Hu, "Confidence-Gated Topology Reasoning with Fiducial Marker Priors
for Occlusion-Robust Lane Graph Prediction", sections III and IV-A.

The **marker frame** is the same everywhere: origin at the center of the black square, x to the right and y up as seen
from the front, z out of the board towards the viewer; metres. The **size** of a marker is the side of its black square,
as in OpenCV, without the white margin.
"""
