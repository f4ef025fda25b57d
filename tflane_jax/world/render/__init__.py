"""The renderer that front views and ring cameras share: camera, polygons, weather."""
