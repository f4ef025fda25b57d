"""The commands of `tflane`, one file each; `arguments` defines their options."""
