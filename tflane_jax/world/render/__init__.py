"""Rendering code used by both front views and ring cameras: camera, polygons, weather, noise, exposure."""
