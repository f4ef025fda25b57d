"""Priors: raw observations turned into fixed-size tokens and masks. No parameters; numpy at load time or under jit."""
