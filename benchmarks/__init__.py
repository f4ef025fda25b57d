"""Benchmarks: each module runs alone (`python -m benchmarks.<name> --out DIR`) and writes JSON and a Markdown table.

Options that several have are those of `timing.command_line`. `marker_confidence` and `marker_visibility` only print.
"""
