"""Benchmarks: each module runs alone (`python -m benchmarks.<name> --out DIR`) and writes JSON and a Markdown table."""
