"""Published PyTorch weights as parameters of our models."""
