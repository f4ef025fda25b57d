"""What models say for their losses alone."""

AUXILIARY = "auxiliary"
"""Collection in which a model leaves what an auxiliary loss looks at; it is filled only where a caller asks for it."""
