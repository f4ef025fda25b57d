"""Parametrised building blocks of the models: functions and Flax modules for one example, without a batch axis."""
