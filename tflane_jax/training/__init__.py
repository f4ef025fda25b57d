"""Training: state, update step, schedules, checkpoints and the loop that joins them.

The program sees a model only through its *task* (`training.task.Trainable`). The loop knows no dataset, metric or
picture: it takes functions that evaluate and draw.
"""
