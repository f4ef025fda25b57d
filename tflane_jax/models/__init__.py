"""The published systems, one file each, built from `tflane_jax.layers`. A model sees ONE example; callers `vmap`."""
