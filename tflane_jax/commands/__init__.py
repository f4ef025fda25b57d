"""What the commands of `tflane` do, one file each; `tflane_jax.cli` says what they take."""
