"""The built-in procedural world: roads, traffic, sensors and their rendering (numpy, seeded)."""
