"""Priors: raw observations -> arrays and masks of fixed size. No parameters; runs in numpy or under jit."""
