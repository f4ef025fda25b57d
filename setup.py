"""Packages of the wheel: those of `tflane_jax/`, and `configs/` as `tflane_jax.configs`. The rest: pyproject.toml."""

from setuptools import find_namespace_packages, find_packages, setup

configs = [f"tflane_jax.{name}" for name in find_namespace_packages(include=["configs", "configs.*"])]

setup(
    packages=[*find_packages(include=["tflane_jax", "tflane_jax.*"]), *configs],
    package_dir={"tflane_jax.configs": "configs"},
    package_data={"tflane_jax": ["py.typed"]},  # type checkers read the annotations
)
