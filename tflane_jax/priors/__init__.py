"""Priors: raw observations -> tokens and masks of fixed size. No parameters; runs in numpy or under jit."""
