"""Benchmarks of accelerators; each module runs alone, and with `--tiny` on a CPU, which shows only that it starts."""
