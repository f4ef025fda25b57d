"""The ring of cameras on the vehicle."""
