"""Training: state, update step, schedules, batches, checkpoints and the loop that joins them (issue letter I).

A *task* (`training.task.Task`) is all that the program knows of a model; the loop knows no dataset, metric or picture
either: evaluation and drawing come in as functions.
"""
