"""Scores of prediction files, whatever framework wrote them: `tflane score`."""
