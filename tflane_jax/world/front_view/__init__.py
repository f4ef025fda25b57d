"""Front views of a road, for monocular lane shapes."""
